"""What the fields of a configuration may hold, said once in their annotations.

    Metres = Annotated[float, Range(above=0, most=1, unit="m")]

    @dataclass
    class Config:
        gain: Metres = 0.1

        def __post_init__(self):
            check(self)

draccus strips the annotations and decodes and helps as before. It lets through what it calls a float (NaN), a whole
number (true) or nothing at all where something is needed, which `check` does not. pydantic's dataclasses, which do
the same, bring an initialiser of their own that LeRobot's registries of dataclasses do not inherit, turn "3" into 3
unless told otherwise, and complain in several lines; what is left of them to use is shorter than its adapter.
"""

import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields
from functools import cache
from numbers import Integral, Real
from pathlib import Path
from types import NoneType, UnionType
from typing import Annotated, Any, Protocol, Union, get_args, get_origin, get_type_hints

from lerobot_constructskill.errors import InputError

LONGEST = 100
"""Characters of a refused value that are quoted."""


class Rule(Protocol):
    """A part of an annotation."""

    def allows(self, value: Any) -> bool:
        """Whether a value of the annotated type is right."""

    def wanted(self, kind: str) -> str:
        """What would be right, where `kind` is what the annotated type is called."""


@dataclass(frozen=True)
class Range:
    """A number between bounds, in a unit; NaN and infinities are never numbers here."""

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
    """A list with something in it."""

    def allows(self, value: Sequence[Any]) -> bool:
        return len(value) > 0

    def wanted(self, kind: str) -> str:
        return "a list of at least one"


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
        except (RuntimeError, AssertionError, NotImplementedError):  # all three mean that there is none
            return False
        return True

    def wanted(self, kind: str) -> str:
        return "a device that PyTorch finds on this machine, such as cpu or cuda"


UNSEEN = (
    "\x00-\x1f\x7f-\x9f\xad\u034f\u061c\u115f\u1160\u17b4\u17b5\u180b-\u180f\u200b-\u200f\u2028-\u202e\u2060-\u206f"
    "\u2800\u3164\ud800-\uf8ff\ufe00-\ufe0f\ufeff\uffa0\ufff0-\uffff\U000e0000-\U0010ffff"
)
"""Characters that cannot be seen, turn text around, have no meaning, or are halves of one, which no file can hold."""

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
RepoId = Annotated[str, Pattern(rf"{_WORD}/{_WORD}", "user/name, each of letters, digits, '_', '-' and '.'")]
Device = Annotated[str, Present()]


def check(config: Any, of: str = "") -> None:
    """Refuse a dataclass one of whose fields holds what its annotation does not allow.

    Args:
        of: what stands before a field's name where the dataclass is itself a field, such as "noise.".

    Raises:
        InputError: the message names the field, its value and what would be right.
    """
    check_values(type(config), {field.name: getattr(config, field.name) for field in fields(config)}, of)


def check_values(annotated: Any, values: Mapping[str, Any], of: str = "") -> None:
    """Refuse values that the annotations of a class or a function do not allow. Raises as `check` does."""
    kinds = _annotations(annotated)
    for name, value in values.items():
        if name in kinds and (wanted := _complaint(value, kinds[name])):
            raise InputError(f"{of}{name} must be {wanted}, not {_quoted(value)}.")


@cache
def _annotations(annotated: Any) -> dict[str, Any]:
    return get_type_hints(annotated, include_extras=True)


def _complaint(value: Any, kind: Any) -> str | None:
    """What would be right in place of `value`; None where it is right."""
    origin, inner = get_origin(kind), get_args(kind)
    if origin is Annotated:
        base, *rules = inner
        if get_origin(base) is list and _is_list(value) and (complaint := _complaint(value, base)):
            return complaint  # of an item, which the rules of the list say nothing about
        wrong = [rule for rule in rules if _complaint(value, base) or not rule.allows(value)]
        return wrong[0].wanted(NAMES.get(base, "a value")) if wrong else None
    if origin in (Union, UnionType):
        if value is None and NoneType in inner:
            return None
        complaints = [_complaint(value, one) for one in inner if one is not NoneType]
        return None if None in complaints else " or ".join(complaints)
    if origin is list:
        wrong = [complaint for item in value if (complaint := _complaint(item, *inner))] if _is_list(value) else ["it"]
        return f"a list, each {_wanted_of(*inner)}" if wrong else None
    if origin is dict:
        if not isinstance(value, Mapping):
            return "a mapping of names to values"
        wrong = [complaint for pair in value.items() for complaint in map(_complaint, pair, inner) if complaint]
        return f"a mapping, with {wrong[0]} in place of what is there" if wrong else None
    return None if kind not in _TESTS or _TESTS[kind](value) else NAMES[kind]


def _wanted_of(kind: Any) -> str:
    """What a value of some type would be: what is said to one that never is."""
    return _complaint(_NOTHING, kind) or "anything"


def _is_list(value: Any) -> bool:
    return isinstance(value, Sequence) and not isinstance(value, str)


def _is_number(value: Any) -> bool:
    return isinstance(value, Real) and not isinstance(value, bool) and math.isfinite(value)


_NOTHING = object()
NAMES = {
    int: "a whole number",
    float: "a finite number",
    bool: "true or false",
    str: "text",
    Path: "a path",
}
_TESTS = {
    int: lambda value: isinstance(value, Integral) and not isinstance(value, bool),
    float: _is_number,
    bool: lambda value: isinstance(value, bool),
    str: lambda value: isinstance(value, str),
    Path: lambda value: isinstance(value, str | Path) and "\0" not in str(value),
}


def _quoted(value: Any) -> str:
    text = " ".join(repr(value).split())
    return text if len(text) <= LONGEST else f"{text[:LONGEST]}..."
