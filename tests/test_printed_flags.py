"""Every flag of a command that the pages print is one that the command knows; nothing is started."""

import argparse
import re
import shlex
import sys
import tomllib
from collections.abc import Callable
from importlib import import_module
from importlib.metadata import EntryPoint
from pathlib import Path

import pytest
from lerobot.configs import PreTrainedConfig, parser
from lerobot.configs.eval import EvalPipelineConfig
from lerobot.configs.train import TrainPipelineConfig
from metadata import write_metadata
from printed import PAGES, ROOT, commands, spans

import lerobot_constructskill.plugin  # noqa: F401
from lerobot_constructskill.policies.frozen_vit.configuration_frozen_vit import FrozenViTChunkConfig
from lerobot_constructskill.presets import find
from lerobot_constructskill.scripts.config import ConfigConfig, write

OURS = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["scripts"]
THEIRS = {"lerobot-train": TrainPipelineConfig, "lerobot-eval": EvalPipelineConfig}

STAND_INS = {
    "constructskill-generate NAME": "constructskill-generate fast",
    "mine.yaml": "",
    "tinybc.yaml": "",
    "outputs/dart_1.yaml": "",
    "plan:wall.yaml": "plan:bond_of_five",
    "=wall.yaml": "=bond_of_five",
    "$seed": "0",
    " ...": "",
    "=...": "=local/any",
}
"""What a reader puts into a command, and what is put there here."""


def entry_point(name: str) -> Callable[[], None]:
    return EntryPoint(name, OURS[name], "console_scripts").load()


def examples() -> list[str]:
    """Those that `--help` prints; the doctor, which has no configuration, prints none."""
    return [entry_point(name).args[2] for name in OURS if name != "constructskill-doctor"]


PRINTED = sorted({command for page in PAGES for command in [*commands(page), *spans(page)]} | {*examples()})
KNOWN = [command for command in PRINTED if command.split()[0] in OURS | THEIRS]


class ParsedError(BaseException):
    """Carries the unknown flags out of a command, past whatever handles its errors."""


@pytest.fixture
def parsing_alone(monkeypatch) -> None:
    """A command of ours ends when its flags are parsed."""
    parse = argparse.ArgumentParser.parse_known_args

    def stop(self, *args, **kwargs):
        if not self.add_help:  # it takes --config_path out for the command's own parser
            return parse(self, *args, **kwargs)
        raise ParsedError(*parse(self, *args, **kwargs)[1])

    monkeypatch.setattr(argparse.ArgumentParser, "parse_known_args", stop)


def words(command: str, folder: Path) -> list[str]:
    """The command as its process gets it."""
    for printed, put in STAND_INS.items():
        command = command.replace(printed, put)
    return shlex.split(
        re.sub(r"\$\((constructskill-config [^)]*)\)", lambda call: configured(call[1], folder), command)
    )


def configured(call: str, folder: Path) -> str:
    """The file that a call of constructskill-config names, for a set of the test's own."""
    _, name, *flags = shlex.split(call)
    kind, _, name = name.partition("/")
    if kind != "train":
        return str(find(kind, name))
    assert [flag.partition("=")[0] for flag in flags] == ["--root"]
    return str(write(ConfigConfig(f"train/{name}", write_metadata(folder / "set", [100] * 9))))


@pytest.mark.parametrize("command", [one for one in KNOWN if one.split()[0] in OURS])
def test_flags_of_ours_are_known(command: str, parsing_alone, monkeypatch, tmp_path) -> None:
    monkeypatch.setattr(sys, "argv", words(command, tmp_path))
    with pytest.raises(ParsedError) as parsed:
        entry_point(sys.argv[0])()
    assert parsed.value.args == ()


@pytest.fixture
def example(monkeypatch) -> None:
    """The plugin of docs/your_policy.md is imported, as LeRobot does it where it is installed."""
    monkeypatch.syspath_prepend(ROOT / "examples" / "your_policy")
    import_module("lerobot_policy_tinybc")


@pytest.mark.parametrize("command", [one for one in KNOWN if one.split()[0] in THEIRS])
def test_fields_of_lerobots_are_known(command: str, example, monkeypatch, tmp_path) -> None:
    monkeypatch.setattr(sys, "argv", words(command, tmp_path))
    checkpoint = FrozenViTChunkConfig(device="cpu")  # in place of one that an earlier command makes
    monkeypatch.setattr(PreTrainedConfig, "from_pretrained", lambda *_, **__: checkpoint)
    for name in ("_config_path_args", "_config_yaml_overrides"):  # what a file says, kept for the process
        monkeypatch.setattr(parser, name, {})

    def read(config):
        return config

    config_class = THEIRS[sys.argv[0]]
    read.__annotations__["config"] = config_class
    assert isinstance(parser.wrap()(read)(), config_class)


def test_a_flag_that_no_command_knows_is_found(parsing_alone, monkeypatch) -> None:
    monkeypatch.setattr(sys, "argv", ["constructskill-film", "--taks=brick_to_bin"])
    with pytest.raises(ParsedError) as parsed:
        entry_point("constructskill-film")()
    assert parsed.value.args == ("--taks=brick_to_bin",)
