"""Every field of every console command, by introspection, with values that break things: a sentence, or valid."""

import json
import math
import tomllib
from contextlib import suppress
from dataclasses import fields, is_dataclass
from functools import cache
from importlib.metadata import EntryPoint
from pathlib import Path
from typing import Any, get_type_hints

import pytest
from draccus.wrappers import docstring

from lerobot_constructskill import parsing
from lerobot_constructskill.envs.configuration_constructskill import ConstructSkillEnvConfig
from lerobot_constructskill.errors import InputError
from lerobot_constructskill.policies.frozen_vit.configuration_frozen_vit import FrozenViTChunkConfig
from lerobot_constructskill.presets import find
from lerobot_constructskill.scripts import console
from lerobot_constructskill.scripts.expert import FilmConfig

SCRIPTS = tomllib.loads((Path(__file__).parents[1] / "pyproject.toml").read_text())["project"]["scripts"]
BARE = {"constructskill-doctor"}
"""The command without a configuration."""

NEEDED = {
    "repo_id": "alice/set",
    "root": "set",
    "task": "brick_to_bin",
    "policies": "[checkpoint]",
    "policy_path": "checkpoint",
    "evaluations": "evaluations",
    "out": "out.yaml",
    "suite": "bins",
    "about": "about.yaml",
    "a": "one",
    "b": "another",
}
"""Something valid for each field without a default."""

BAD = ["nan", "inf", "-1", "0", "0.5", "1000000000", "", "[1]", "[]", "[nan]", "{a: 1}", "null", "true", ".", "../x"]
BAD += ["é名\u0301", "a\\nb", "x" * 5000, "!!python/x 1"]


@pytest.fixture(scope="module", autouse=True)
def helps_are_read_once():
    """draccus looks for the help of each field in the source, for every command line: most of the time here."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(docstring, "get_attribute_docstring", cache(docstring.get_attribute_docstring))
        yield


@cache
def config_classes() -> dict[str, type]:
    """The configuration of every command, as `console.command` hands it to `console.run`."""
    found: dict[str, type] = {"frozen_vit": FrozenViTChunkConfig, "constructskill": ConstructSkillEnvConfig}
    for command, entry in SCRIPTS.items():
        if command in BARE:
            continue
        found[command] = EntryPoint(command, entry, "console_scripts").load().args[0]
    return found


def flat_fields(config_class: type, before: str = "") -> list[str]:
    """Names of fields as flags spell them, `noise.sigma` for instance."""
    hints, names = get_type_hints(config_class), []
    for field in fields(config_class):
        inner = hints[field.name]
        of_field = flat_fields(inner, f"{before}{field.name}.") if is_dataclass(inner) else []
        names += [f"{before}{field.name}", *of_field]
    return names


def flags(command: str, config_class: type) -> list[str]:
    if command == "constructskill-study":
        return [f"--config_path={find('study', 'smoke')}"]
    if command == "constructskill-dagger":
        return [f"--config_path={find('dagger', 'smoke')}", f"--repo_id={NEEDED['repo_id']}"]
    return [f"--{field.name}={NEEDED[field.name]}" for field in fields(config_class) if is_needed(field)]


def is_needed(field: Any) -> bool:
    return field.name in NEEDED and "MISSING" in repr(field.default) and "MISSING" in repr(field.default_factory)


def numbers(value: Any) -> list[float]:
    if is_dataclass(value):
        return [number for field in fields(value) for number in numbers(getattr(value, field.name))]
    if isinstance(value, list | tuple):
        return [number for item in value for number in numbers(item)]
    return [value] if isinstance(value, float) else []


def outcome(config_class: type, arguments: list[str]) -> Any:
    """The configuration, or the exception that the console makes a sentence of."""
    try:
        return parsing.parse(config_class, arguments)
    except Exception as error:
        return error


CASES = [(command, field) for command, config_class in config_classes().items() for field in flat_fields(config_class)]


def test_every_command_with_a_configuration_is_tried() -> None:
    assert set(config_classes()) - {"frozen_vit", "constructskill"} == set(SCRIPTS) - BARE


def test_the_home_folder_is_found_behind_an_equals_sign(tmp_path, monkeypatch) -> None:
    monkeypatch.setenv("HOME", str(tmp_path))
    made = parsing.parse(config_classes()["constructskill-check"], ["--root=~/x"])
    assert made.root == tmp_path / "x"


@pytest.mark.parametrize(("command", "field"), CASES)
def test_a_bad_value_is_a_sentence_or_valid(command: str, field: str, tmp_path, monkeypatch) -> None:
    monkeypatch.chdir(tmp_path)
    config_class = config_classes()[command]
    for value in BAD:
        made = outcome(config_class, [*flags(command, config_class), f"--{field}={value}"])
        if isinstance(made, Exception):
            status, said = console._status_and_sentence(made)
            assert status == console.REFUSED, f"{field}={value!r}: {type(made).__name__}: {said}"
            assert said and "\n" not in said
        else:
            assert all(map(math.isfinite, numbers(made))), f"{field}={value!r} was accepted"
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("command", [name for name in config_classes() if name in SCRIPTS])
@pytest.mark.parametrize("name", ["../../../x", "a/../b", "/etc/x", "a", "a/b/c", "a/b\nc", "a/-b", "a b/c", ""])
def test_no_name_leads_out_of_the_data_folder(command: str, name: str) -> None:
    config_class = config_classes()[command]
    for field in ("repo_id", "out_repo_id"):
        if field in {one.name for one in fields(config_class)}:
            made = outcome(config_class, [*flags(command, config_class), f"--{field}={name!r}"])
            assert isinstance(made, Exception) and f"{field} must be user/name" in str(made)


@pytest.mark.parametrize("out", ["film", "film.gif", "."])
def test_a_film_has_the_ending_that_it_can_be_written_by(out):
    with pytest.raises(InputError, match=r"ends in \.mp4"):
        FilmConfig(out=Path(out))


@pytest.mark.parametrize(
    ("command", "flag", "field", "value"),
    [
        ("constructskill-push", "--tag=1.10", "tag", "1.10"),
        ("constructskill-push", "--tag=null", "tag", None),
        ("constructskill-verify", "--value=0x10", "value", "0x10"),
        ("constructskill-verify", "--value=a # b", "value", "a # b"),
        ("constructskill-report", "--root=2026", "root", Path("2026")),
        ("constructskill-generate", "--noise.sigma=1e-4", "noise", None),
    ],
)
def test_text_is_what_was_written(command, flag, field, value) -> None:
    config_class = config_classes()[command]
    given = [flag for flag in flags(command, config_class) if not flag.startswith(f"--{field}=")]
    made = parsing.parse(config_class, [*given, flag])
    assert field == "noise" or getattr(made, field) == value


GENERATE = "repo_id: a/b\n"


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("episodes: true", "episodes must be a whole number from 1 to 1000000, not True"),
        ("episodes: '3'", "episodes must be a whole number from .*, not '3'"),
        ("episodes: 010", "episodes must be a whole number from .*, not '010'"),
        ("root: 1.10", r"root must be one line of text, not 1.1. Put it in quotation marks."),
        ("root: [a]", "root must be one line of text, not"),
        ("noise: []", "noise must be a mapping, not "),
        ("noise: null", "noise must be a mapping, not None"),
        ("noise: {sigma: true}", "noise.sigma must be a finite number from 0 to 1 m, not True"),
        ("expert: 3", "expert must be a mapping, not 3"),
    ],
)
def test_nothing_is_taken_for_something_else(text, said, tmp_path) -> None:
    (tmp_path / "mine.yaml").write_text(GENERATE + text)
    with pytest.raises(InputError, match=said):
        parsing.parse(config_classes()["constructskill-generate"], [f"--config_path={tmp_path / 'mine.yaml'}"])


def test_a_policys_own_fields_are_looked_at_too() -> None:
    import lerobot.policies  # noqa: F401  registers the policies

    from lerobot_constructskill.policy_types import decode_policy

    with pytest.raises(InputError, match="optimizer_lr must be a finite number, not True"):
        decode_policy({"type": "act", "optimizer_lr": True})
    assert decode_policy({"type": "act", "replace_final_stride_with_dilation": True})
    assert decode_policy({"type": "frozen_vit", "optimizer_lr": "1e-3"}).optimizer_lr == 1e-3


def test_every_policy_that_is_installed_is_read_as_it_was_written(monkeypatch) -> None:
    """LeRobot's annotations are not always those of the values: what its own defaults are is no mistake."""
    import draccus
    import lerobot.policies  # noqa: F401  registers the policies
    from lerobot.configs import PreTrainedConfig

    monkeypatch.setattr("huggingface_hub.constants.HF_HUB_OFFLINE", True)
    read = []
    for name, kind in PreTrainedConfig.get_known_choices().items():
        with suppress(OSError):  # two ask the Hub for what they are built on
            written = json.loads(json.dumps(draccus.encode(kind())))
            parsing.decode(PreTrainedConfig, {"type": name, **written})
            read.append(name)
    assert {"act", "diffusion", "smolvla", "pi05", "frozen_vit"} <= {*read}
