"""Bounds of fields: what is refused, and that a refusal names the field, its value and what would be right."""

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import pytest

from lerobot_constructskill.bounds import Among, Count, Device, NotEmpty, Range, RepoId, Seed, Text, check
from lerobot_constructskill.errors import InputError
from lerobot_constructskill.parsing import parse

Metres = Annotated[float, Range(above=0, most=1, unit="m")]


@dataclass
class Config:
    name: RepoId = "alice/set"  # what it is called
    gain: Metres = 0.1
    level: float = 0.0
    count: Count | None = None
    seeds: Annotated[list[Seed], NotEmpty()] | None = None
    matrix: list[list[float]] | None = None
    model: Annotated[str, Among(("fixed", "dart"))] = "fixed"
    label: Text | None = None
    root: Path | None = None
    device: Device | None = None
    facts: dict[str, str] | None = None
    flag: bool = False

    def __post_init__(self):
        check(self, "noise.")


@pytest.mark.parametrize(
    ("field", "value", "said"),
    [
        ("gain", math.nan, "noise.gain must be a finite number above 0 m and at most 1 m, not nan."),
        ("gain", 0, "above 0 m and at most 1 m, not 0."),
        ("gain", 1.5, "not 1.5."),
        ("gain", None, "not None."),
        ("gain", True, "not True."),
        ("level", math.inf, "noise.level must be a finite number, not inf."),
        ("count", 0, "a whole number from 1 to 1000000, not 0."),
        ("count", 10**9, "not 1000000000."),
        ("count", 2.0, "a whole number"),
        ("seeds", [], r"a list of at least one, each a whole number from 0 to \d+, not \[\]"),
        ("seeds", [0, -1], r"a list of at least one, each a whole number from 0 to \d+, not \[0, -1\]"),
        ("seeds", "12", "not '12'."),
        ("matrix", [[1.0], [math.nan]], "noise.matrix must be a list, each a list, each a finite number"),
        ("model", "white", "noise.model must be one of fixed, dart, not 'white'."),
        ("model", ["fixed"], r"one of fixed, dart, not \['fixed'\]"),
        ("name", "../x", "noise.name must be user/name"),
        ("name", "a/b\n", "must be user/name"),
        ("name", "a/b--c", "must be user/name"),
        ("name", "a/" + "b" * 97, "must be user/name"),
        ("label", "", "one line of text, not ''."),
        ("label", "a\nb", "one line of text"),
        *(
            ("label", text, "one line of text")
            for text in ("\x1b", "a\x1b[1m", " ", "\ud800", "\u2800", "\u3164", "a\xad")
        ),
        *(("label", text, "one line of text") for text in ("\u061c", "\U000e0041", "\u202eb", "\u200b")),
        ("root", "a\0b", "a path"),
        ("device", "quantum", "a device that PyTorch finds"),
        ("device", "cpu; rm", "a device that PyTorch finds"),
        ("facts", [1], "a mapping"),
        ("facts", {"a": 1}, "a mapping"),
        ("flag", 1, "true or false"),
        ("label", ["x" * 999], r"not \['x{98}\.\.\.\.$"),
    ],
)
def test_what_is_not_allowed_is_refused_in_one_sentence(field: str, value: Any, said: str) -> None:
    with pytest.raises(InputError, match=said) as refusal:
        Config(**{field: value})
    assert "\n" not in str(refusal.value)


@pytest.mark.parametrize(
    "fields",
    [
        {},
        {"gain": 1},
        {"gain": np.float32(0.5), "count": np.int64(3)},
        {"seeds": [0, 2**31 - 1], "matrix": [[1, 2.0]], "facts": {"a": "b"}},
        {"root": "some/where", "device": "cpu", "name": "Alice_1/set.v2-x"},
    ],
)
def test_what_is_allowed_passes(fields: dict[str, Any]) -> None:
    Config(**fields)


def test_flags_are_as_without_annotations() -> None:
    assert parse(Config, ["--gain=0.5", "--seeds=[1, 2]"]) == Config(gain=0.5, seeds=[1, 2])
