"""What the fields of a configuration may hold, said once in their annotations.

    Metres = Annotated[float, Range(above=0, most=1, unit="m")]

    @dataclass
    class Config:
        gain: Metres = 0.1

        def __post_init__(self):
            check(self)

draccus strips the annotations, decodes and prints help as before. draccus accepts NaN as a float, true as a whole
number, and None where a value is needed; `check` refuses them. pydantic's dataclasses bring an initialiser of their
own, which LeRobot's registries of dataclasses do not inherit, and its patterns know no look-ahead.
"""

import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields, is_dataclass
from numbers import Integral, Real
from pathlib import Path
from types import NoneType, UnionType
from typing import Annotated, Any, Union, get_args, get_origin, get_type_hints

from lerobot_constructskill.errors import InputError

LONGEST = 100
"""Largest number of characters of a refused value that a message quotes."""


@dataclass(frozen=True)
class Range:
    """A finite number between bounds, in a unit.

    Every rule has `allows`, whether a value of the annotated type is right, and `wanted`, which describes the right
    values; its argument `kind` describes all values of the annotated type.
    """

    least: float = -math.inf
    most: float = math.inf
    above: float = -math.inf
    unit: str = ""

    def allows(self, value: Real) -> bool:
        return self.least <= value <= self.most and value > self.above

    def wanted(self, kind: str) -> str:
        low, high, unit = max(self.least, self.above), self.most, f" {self.unit}".rstrip()
        if low == high:
            return f"{low}{unit}"
        if self.above > -math.inf:
            return f"{kind} above {low}{unit}" + (f" and at most {high}{unit}" if high < math.inf else "")
        return f"{kind} of at least {low}{unit}" if high == math.inf else f"{kind} from {low} to {high}{unit}"


@dataclass(frozen=True)
class Among:
    """One of some values."""

    choices: Sequence[Any]

    def allows(self, value: Any) -> bool:
        return value in self.choices

    def wanted(self, kind: str) -> str:
        return f"one of {', '.join(map(str, self.choices))}"


@dataclass(frozen=True)
class NotEmpty:
    """A list with at least one item."""

    def allows(self, value: Sequence[Any]) -> bool:
        return len(value) > 0

    def wanted(self, kind: str) -> str:
        return kind.replace("a list", "a list of at least one", 1)


@dataclass(frozen=True)
class Pattern:
    """Text that a regular expression matches as a whole; `meaning` is what the text is."""

    expression: str
    meaning: str

    def allows(self, value: str) -> bool:
        return re.fullmatch(self.expression, value) is not None

    def wanted(self, kind: str) -> str:
        return self.meaning


@dataclass(frozen=True)
class Present:
    """The name of a device that PyTorch has."""

    def allows(self, value: str) -> bool:
        if not re.fullmatch(r"[a-z]+(:\d{1,3})?", value) or value == "meta":
            return False
        import torch

        try:
            torch.empty(0, device=value)
        except (RuntimeError, AssertionError, NotImplementedError):  # PyTorch has three ways to say that it is absent
            return False
        return True

    def wanted(self, kind: str) -> str:
        return "a device that PyTorch finds on this machine, such as cpu or cuda"


UNSEEN = (
    "\x00-\x1f\x7f-\x9f\xad\u034f\u061c\u115f\u1160\u17b4\u17b5\u180b-\u180f\u200b-\u200f\u2028-\u202e\u2060-\u206f"
    "\u2800\u3164\ud800-\uf8ff\ufe00-\ufe0f\ufeff\uffa0\ufff0-\uffff\U000e0000-\U0010ffff"
)
"""Characters that are invisible, reverse the direction of text, have no meaning, or are half of a surrogate pair."""

_WORD = r"(?!.*(?:--|\.\.))[A-Za-z0-9_](?:[A-Za-z0-9._-]{0,94}[A-Za-z0-9_])?"

Count = Annotated[int, Range(1, 1_000_000)]
Steps = Annotated[int, Range(1, 100_000, unit="steps")]
BatchSize = Annotated[int, Range(1, 65_536)]
Workers = Annotated[int, Range(1, 1024)]
Seed = Annotated[int, Range(0, 2**31 - 1)]
Episode = Annotated[int, Range(0, 10_000_000)]
Episodes = Annotated[list[Episode], NotEmpty()]
Text = Annotated[str, Pattern(rf"(?=.*\S)[^{UNSEEN}]+", "one line of text")]
Word = Annotated[str, Pattern(_WORD, "a name of letters, digits, '_', '-' and '.'")]
Cameras = Annotated[str, Pattern(rf"{_WORD}(\+{_WORD})*", "a camera's name, or several with '+' between")]
RepoId = Annotated[str, Pattern(rf"{_WORD}/{_WORD}", "user/name, each of letters, digits, '_', '-' and '.'")]
Device = Annotated[str, Present()]


class Checked:
    """Base of a dataclass that is checked when it is made. Raises as `check` does."""

    def __post_init__(self):
        check(self)


def seed_of(folder: Path) -> int:
    """The training seed that a folder is named after: `seed_0`, `seed_1`, ...

    Raises:
        InputError: it is of none.
    """
    found = re.fullmatch("seed_(0|[1-9][0-9]{0,9})", folder.name)
    if found is None or not allows(Seed, int(found[1])):
        raise InputError(f"'{folder}' is of no training seed: name it seed_0, seed_1, ..., or move it away.")
    return int(found[1])


def check(config: Any, of: str = "") -> None:
    """Refuse a dataclass that has a field whose value its annotation does not allow.

    Args:
        of: what stands before a field's name where the dataclass is itself a field, such as "noise.".

    Raises:
        InputError: the message names the field, its value and what would be right.
    """
    check_fields(type(config), {field.name: getattr(config, field.name) for field in fields(config)}, of)


def check_fields(annotated: Any, values: Mapping[str, Any], of: str = "") -> None:
    """Refuse values that the annotations of a class or a function do not allow. Raises as `check` does."""
    kinds = get_type_hints(annotated, include_extras=True)
    for name, value in values.items():
        if name in kinds and not allows(kinds[name], value):
            raise InputError(refusal(f"{of}{name}", kinds[name], value))


def refusal(name: str, kind: Any, value: Any) -> str:
    """The sentence that refuses a field's value."""
    text = " ".join(repr(value).split())
    return f"{name} must be {wanted(kind)}, not {text if len(text) <= LONGEST else f'{text[:LONGEST]}...'}."


def allows(kind: Any, value: Any) -> bool:
    """Whether a value is what an annotation describes; types that this module does not know allow everything."""
    origin, inner = get_origin(kind), get_args(kind)
    if origin is Annotated:
        return allows(inner[0], value) and all(rule.allows(value) for rule in inner[1:])
    if origin in UNIONS:
        return any(allows(one, value) for one in inner)
    if origin is list:
        return isinstance(value, Sequence) and not isinstance(value, str) and all(allows(*inner, one) for one in value)
    if origin is dict:
        return isinstance(value, Mapping) and all(all(map(allows, inner, pair)) for pair in value.items())
    if is_dataclass(kind):
        return isinstance(value, Mapping | kind)
    return kind not in TESTS or TESTS[kind](value)


def wanted(kind: Any) -> str:
    """Describe the values that an annotation allows."""
    origin, inner = get_origin(kind), get_args(kind)
    if origin is Annotated:
        described = wanted(inner[0])
        for rule in inner[1:]:
            described = rule.wanted(described)
        return described
    if origin in UNIONS:
        return " or ".join(wanted(one) for one in inner if one is not NoneType)
    if origin is list:
        return f"a list, each {wanted(*inner)}"
    if origin is dict or is_dataclass(kind):
        return "a mapping" + (f" of {wanted(inner[0])} to {wanted(inner[1])}" if inner else "")
    return NAMES.get(kind, "something else")


UNIONS = (Union, UnionType)
NAMES = {
    int: "a whole number",
    float: "a finite number",
    bool: "true or false",
    str: "text",
    Path: "a path",
    Any: "anything",
}
TESTS = {
    int: lambda value: isinstance(value, Integral) and not isinstance(value, bool),
    float: lambda value: isinstance(value, Real) and not isinstance(value, bool) and math.isfinite(value),
    bool: lambda value: isinstance(value, bool),
    str: lambda value: isinstance(value, str),
    Path: lambda value: isinstance(value, str | Path) and "\0" not in str(value),
    NoneType: lambda value: value is None,
}
