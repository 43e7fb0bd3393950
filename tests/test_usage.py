"""`--help` of every command: which values stand before the flags, something on each flag, an example."""

import re
import sys
import tomllib
from dataclasses import MISSING, dataclass, field, fields
from importlib.metadata import EntryPoint
from pathlib import Path

import pytest

from lerobot_constructskill.presets import names
from lerobot_constructskill.scripts.usage import help_of

PYPROJECT = tomllib.loads((Path(__file__).parents[1] / "pyproject.toml").read_text())
MAINS = {
    name: EntryPoint(name, entry, "console_scripts").load()
    for name, entry in PYPROJECT["project"]["scripts"].items()
    if name != "constructskill-doctor"  # it has no configuration
}


@pytest.fixture
def printed(request, monkeypatch, capsys) -> str:
    monkeypatch.setattr(sys, "argv", [request.param, "--help"])
    monkeypatch.setenv("COLUMNS", "100")
    MAINS[request.param]()
    return capsys.readouterr().out


@pytest.mark.parametrize(("name", "printed"), [(name, name) for name in MAINS], indirect=["printed"])
def test_help_has_what_stands_before_the_flags_an_example_and_words_on_each_flag(name, printed):
    config_class, _, example, presets, first = MAINS[name].args
    usage = re.match(rf"usage: {name} (.*)\[--FLAG=VALUE", printed)[1]
    required = {one.name for one in fields(config_class) if one.default is one.default_factory is MISSING}
    stands = [name.upper() if name in required else f"[{name.upper()}]" for name in first]
    assert usage.split() == (["[NAME]"] if presets else stands)
    assert f"example: {example}" in printed and name in example
    assert not re.findall(r"^  (--\S+ \S+)\n(?! {26})", printed, re.M), "nothing is said of them"
    told = {flag.partition(".")[0] for flag in re.findall(r"^  --(\S+)", printed, re.M)}
    assert {one.name for one in fields(config_class)} <= told
    assert all(shipped in printed for shipped in names(presets)) if presets else True
    assert max(map(len, printed.replace(example, "").splitlines())) <= 98


@dataclass
class Base:
    """A base.

    Args:
        gain: how strong, in one
            sentence or two.
    """

    gain: float = 0.5


@dataclass
class Inner:
    count: int = 3  # how many


@dataclass
class Config(Base):
    """What it does.

    Args:
        out: where it goes.

    Raises:
        ValueError: never.
    """

    out: Path = field(kw_only=True)
    inner: Inner = field(default_factory=Inner)
    quiet: bool = False  # 100 % silent
    label: str | None = None  # default: none at all


def test_flags_are_told_of_by_comments_and_by_the_documentation_of_bases(monkeypatch):
    monkeypatch.setenv("COLUMNS", "100")
    told = " ".join(help_of(Config, "do", "do --out=here", None, (), "The end.").split())
    for words in (
        "usage: do [--FLAG=VALUE ...] example: do --out=here What it does. options:",
        "--gain GAIN how strong, in one sentence or two (default: 0.5)",
        "--out OUT where it goes (required)",
        "--quiet QUIET 100 % silent (default: false)",
        "--label LABEL default: none at all flags of inner: --inner.count COUNT how many (default: 3) The end.",
    ):
        assert words in told, told
    assert "Raises" not in told and "Config file" not in told


def test_a_field_that_can_stand_before_the_flags_is_not_required_twice():
    assert "usage: do OUT [--FLAG" in (told := help_of(Config, "do", "do here", None, ("out",), ""))
    assert "(required)" not in told
