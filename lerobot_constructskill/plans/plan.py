"""A plan of a wall: which elements are laid where, in which order, on and beside which others."""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from functools import cached_property, reduce
from typing import Annotated, Any

import yaml

from lerobot_constructskill.bounds import Among, Range, Word, check
from lerobot_constructskill.contract import BRICK, MAX_PLACEMENTS
from lerobot_constructskill.errors import InputError
from lerobot_constructskill.files import Yaml
from lerobot_constructskill.presets import find


@dataclass(frozen=True)
class Kind:
    """A kind of element.

    Args:
        size: nominal edges in metres; the jaws hold it along y.
        density: kg/m3.
        factor: of EN 771-1: an edge deviates by up to factor * sqrt(edge in mm), in mm.
        deviation: an edge deviates by up to this, in metres.
    """

    size: tuple[float, float, float]
    density: float
    factor: float = 0.0
    deviation: float = 0.0

    @property
    def deviations(self) -> tuple[float, ...]:
        """How far each edge may be off its nominal length, in metres."""
        return tuple(self.deviation + self.factor * (1000 * edge) ** 0.5 / 1000 for edge in self.size)


KINDS = {
    "brick": Kind(BRICK, density=1000.0, factor=0.25),
    "post": Kind((0.06, 0.06, 0.12), density=450.0, deviation=0.001),
    "beam": Kind((0.34, 0.06, 0.06), density=450.0, deviation=0.001),
}
"""Bricks within EN 771-1's category T2 of mean dimensions; sawn timber within 1 mm, EN 336's class 2 up to 100 mm."""

Metres = Annotated[float, Range(-1, 1, unit="m")]


@dataclass(frozen=True)
class Element:
    """One element of a plan and where it goes.

    Args:
        kind: one of `KINDS`.
        at: x and y of its middle, in metres in the world's frame; the robot's base stands at x = -0.615, y = 0.
        beside: the element that it continues in the direction of x, with a joint in between.
        joint: width of that joint, in metres.
        on: the elements that carry it; the ground where there is none. Without `at` and `beside` its middle is over
            the middle of these.
    """

    kind: Annotated[str, Among(tuple(KINDS))]
    at: list[Metres] | None = None
    beside: str | None = None
    joint: Annotated[float, Range(0, 0.5, unit="m")] = 0.010
    on: list[str] = field(default_factory=list)

    def __post_init__(self) -> None:
        check(self)

    @property
    def references(self) -> list[str]:
        """The elements from which its place follows."""
        return [*([] if self.beside is None else [self.beside]), *self.on]


type Position = tuple[Any, Any, Any]


@dataclass(frozen=True)
class Plan:
    """A list of placements.

    Args:
        elements: name to element, in the order of laying.
        instruction: what the wall is, which heads its picture. A task asks for it in a sentence of its own.
        tolerance: how far the middle of an element may be off its place in x and in y, in metres.
        standard: where the tolerance comes from.

    Raises:
        InputError: an element's place does not follow from elements that are laid before it, or a value is out of its
            range.
    """

    elements: dict[Word, Element]
    instruction: str = "Build the wall."
    tolerance: Annotated[float, Range(0.001, 0.05, unit="m")] = 0.005
    standard: str = ""

    def __post_init__(self) -> None:
        check(self)
        if not 1 <= len(self.elements) <= MAX_PLACEMENTS:
            raise InputError(f"A plan has 1 to {MAX_PLACEMENTS} elements, not {len(self.elements)}.")
        laid: set[str] = set()
        for name, element in self.elements.items():
            self._check_place(name, element, laid)
            laid.add(name)

    def _check_place(self, name: str, element: Element, laid: set[str]) -> None:
        said = [element.at is not None, element.beside is not None]
        if all(said) or not (any(said) or element.on):
            raise InputError(
                f"The element '{name}' needs one place: at (x and y), beside (an element) or, alone, on (elements)."
            )
        if element.at is not None and len(element.at) != 2:
            raise InputError(f"The element '{name}' has at {element.at}, which must be x and y in metres.")
        if twice := next((other for other in element.on if element.on.count(other) > 1), None):
            raise InputError(f"The element '{name}' names '{twice}' twice in `on`.")
        for other in element.references:
            if other not in self.elements:
                raise InputError(f"The element '{name}' names '{other}', which is not in the plan.")
            if other not in laid:
                raise InputError(
                    f"The element '{name}' names '{other}', which is not laid before it; the order of laying is "
                    "that of the file."
                )

    @cached_property
    def kinds(self) -> list[Kind]:
        """The kind of every element, in order."""
        return [KINDS[element.kind] for element in self.elements.values()]

    def resting(self, sizes: Sequence[Position], seen: Callable[[int, Position], Position]) -> list[Position]:
        """Where the middle of every element comes to rest, in metres, as what is laid before it really lies.

        Numbers may be floats or arrays of one shape.

        Args:
            sizes: of every element in metres.
            seen: where the middle of an element is whose place is known, and its place if it is not laid.
        """
        numbers = {name: number for number, name in enumerate(self.elements)}
        places: list[Position] = []
        found: list[Position] = []
        for number, element in enumerate(self.elements.values()):
            own, on = sizes[number], [numbers[name] for name in element.on]
            if element.at is not None:
                x, y = element.at
            elif element.beside is not None:
                other = numbers[element.beside]
                x = found[other][0] + (sizes[other][0] + own[0]) / 2 + element.joint
                y = found[other][1]
            else:
                x, y = (sum(found[other][axis] for other in on) / len(on) for axis in (0, 1))
            floor = _floor(own[0], [(found[other], sizes[other]) for other in on])
            places.append((x, y, floor + own[2] / 2))
            found.append(seen(number, places[-1]))
        return places

    @cached_property
    def drawn(self) -> list[Position]:
        """Where every element comes to rest as the plan is drawn, all sizes nominal."""
        return self.resting([kind.size for kind in self.kinds], lambda _, place: place)

    def facts(self) -> dict[str, Any]:
        """The plan as plain values."""
        return asdict(self)

    def laid(self) -> dict[str, Any]:
        """What of it decides how it is laid and what counts as placed: all but its words."""
        return {name: value for name, value in self.facts().items() if name not in ("instruction", "standard")}


def _floor(length: Any, supports: Sequence[tuple[Position, Position]]) -> Any:
    """Height in metres on which the middle of an element of this length comes to rest.

    On two supports of uneven height it leans: on the inner edge of the higher one, and on the lower one as far out as
    both reach.

    Args:
        supports: the middle and the size of each.
    """
    tops = [middle[2] + size[2] / 2 for middle, size in supports]
    if len(supports) != 2:
        return reduce(_larger, tops, 0.0)
    (a, a_size), (b, b_size) = supports
    inner = (abs(a[0] - b[0]) - (a_size[0] + b_size[0]) / 2) / 2
    outer = -_larger(-length / 2, -inner - (a_size[0] + b_size[0]) / 2)
    if isinstance(inner, float) and inner + outer <= 0:  # side by side, which a check of the plan refuses
        return _larger(*tops)
    return _larger(*tops) - abs(tops[0] - tops[1]) * inner / (inner + outer)


def _larger(a: Any, b: Any) -> Any:
    return (a + b + abs(a - b)) / 2


PLAN = Yaml("a plan", Plan)


def read_plan(name: str) -> Plan:
    """The plan in `configs/plan` that is called `name`, or in the file `name`.

    Raises:
        MissingError: there is neither.
        InputError: it is no plan.
    """
    return PLAN.read(find("plan", name))


def supplies(plan: Plan) -> Iterator[tuple[float, float]]:
    """x and y in metres of where each element waits, in order."""
    return (SUPPLIES[number] for number, _ in enumerate(plan.elements))


SUPPLIES = (
    (-0.02, 0.06),
    (-0.02, 0.23),
    (-0.30, 0.23),
    (-0.02, 0.40),
    (-0.30, 0.40),
    (-0.30, 0.57),
    (-0.58, 0.40),
    (-0.58, 0.57),
    (-0.30, 0.06),
)
"""x and y in metres of the places where elements wait, on the other side of the robot than walls."""

WAITS_WITHIN = 0.03
"""Metres in x and in y by which an element may wait off its place."""


def written(plan: Mapping[str, Any]) -> str:
    """A plan's facts as the YAML that `read_plan` reads."""
    return yaml.safe_dump(plan, sort_keys=False, allow_unicode=True, width=110)
