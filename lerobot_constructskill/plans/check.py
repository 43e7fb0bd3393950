"""Whether a plan can be built by this robot: reach, room for the fingers, support, and the order of laying."""

from collections.abc import Iterator, Sequence
from itertools import combinations
from math import hypot

from lerobot_constructskill.contract import ROBOT_BASE, highest_tcp
from lerobot_constructskill.errors import InputError
from lerobot_constructskill.plans.plan import KINDS, WAITS_WITHIN, Kind, Plan, Position, supplies

NEAREST, FARTHEST = 0.30, 0.76
"""Horizontal distances in metres from the robot's base between which the hand lays with its fingers down."""

CARRIED_OVER, HELD_BELOW = 0.04, 0.03
"""Height in metres at which an element is carried over all others, and of the TCP below an element's top."""

HIGHEST = 0.42
"""Height in metres of an element's top up to which the hand lays: a fifth brick on four was held and never let go."""

WRIST_ABOVE, WRIST_LENGTH, WRIST_WIDTH = 0.15, 0.16, 0.12
"""In metres: the wrist's underside over the TCP, how far it reaches from there toward the robot, and its width."""

JAWS, FINGER_WIDTH, TIPS = 0.062, 0.022, 0.012
"""In metres: from the TCP along the jaws to the outside of an open finger, a finger's width, and its tip below it."""

CLOSE = 0.0005
"""Metres that neighbours may be into each other by rounding."""

LEANING = 0.006
"""Largest planned difference in metres between the heights of what carries one element."""

APART = 0.12
"""Distance in metres across the wall that an element keeps from those that wait."""


type Box = tuple[str, Position, Kind]
"""Name, middle and kind of an element."""


def check_plan(plan: Plan) -> None:
    """Refuse a plan that cannot be built.

    Raises:
        InputError: the message names the element and what is wrong with it, and says how many other things are.
    """
    found = list(complaints(plan))
    if found:
        more = f" {len(found) - 1} more: `constructskill-plan` lists them." if len(found) > 1 else ""
        raise InputError(found[0] + more)


def complaints(plan: Plan) -> Iterator[str]:
    """Sentences about what cannot be built, in the order of laying."""
    laid: list[Box] = []
    yield from _of_waiting(plan)
    for box in zip(plan.elements, plan.drawn, plan.kinds, strict=True):
        yield from _of_reach(*box, laid, plan)
        yield from _of_support(*box, [other for other in laid if other[0] in plan.elements[box[0]].on])
        for other in laid:
            yield from _of_earlier(*box, *other)
            yield from _of_lengths(plan, box, other)
        laid.append(box)


def _of_reach(name: str, place: Position, kind: Kind, laid: list[Box], plan: Plan) -> Iterator[str]:
    away = hypot(place[0] - ROBOT_BASE[0], place[1] - ROBOT_BASE[1])
    if not NEAREST <= away <= FARTHEST:
        yield (
            f"The element '{name}' lies {away:.2f} m from the robot's base at x = {ROBOT_BASE[0]}, y = "
            f"{ROBOT_BASE[1]:g}; the hand lays between {NEAREST} and {FARTHEST} m."
        )
        return
    if place[0] < ROBOT_BASE[0]:
        yield f"The element '{name}' lies behind the robot, whose base stands at x = {ROBOT_BASE[0]}."
        return
    stands = [*(one.size[2] for one in plan.kinds), *(middle[2] + one.size[2] / 2 for _, middle, one in laid)]
    carried = max(stands) + CARRIED_OVER + kind.size[2] - HELD_BELOW
    highest = highest_tcp(away)
    if carried > highest:
        yield (
            f"The element '{name}' has to be carried {carried:.2f} m high over what is laid before it; {away:.2f} m "
            f"from its base the arm reaches {highest:.2f} m."
        )
    if (top := place[2] + kind.size[2] / 2) > HIGHEST:
        yield f"The top of the element '{name}' lies {top:.2f} m high; the hand lays up to {HIGHEST} m."
    for other, middle, one in laid:
        if middle[2] + one.size[2] / 2 > top - HELD_BELOW + WRIST_ABOVE and _is_under_wrist(place, middle, one):
            yield f"There is no room for the arm at '{name}' behind '{other}', which is higher: lay '{name}' first."
    for start, one in zip(supplies(plan), plan.kinds, strict=True):
        if max(_gaps(place, kind, start, one)) < APART:
            yield f"The element '{name}' lies where elements wait, on the side of the robot where y is above 0."
            return


def _is_under_wrist(place: Position, middle: Position, kind: Kind) -> bool:
    """Whether an element lies between where the hand is and the robot, so near that the wrist would be in it."""
    toward = [ROBOT_BASE[axis] - place[axis] for axis in (0, 1)]
    away = hypot(*toward)
    points = ([place[axis] + toward[axis] / away * WRIST_LENGTH * step / 4 for axis in (0, 1)] for step in range(5))
    return any(
        all(abs(point[axis] - middle[axis]) < (kind.size[axis] + WRIST_WIDTH) / 2 for axis in (0, 1))
        for point in points
    )


def _gaps(place: Sequence[float], kind: Kind, other: Sequence[float], its_kind: Kind) -> list[float]:
    """Distances in metres between two elements along each axis of their places, below 0 where they overlap."""
    return [
        abs(a - b) - (size + its_size) / 2
        for a, b, size, its_size in zip(place, other, kind.size, its_kind.size, strict=False)
    ]


def _of_waiting(plan: Plan) -> Iterator[str]:
    """Elements that may stand in each other before the first is laid."""
    waiting = list(zip(plan.elements, supplies(plan), plan.kinds, strict=True))
    for number, (name, place, kind) in enumerate(waiting):
        for other, its_place, its_kind in waiting[:number]:
            if max(_gaps(place, kind, its_place, its_kind)) < 2 * WAITS_WITHIN:
                yield (
                    f"The elements '{other}' and '{name}' would overlap where they wait: their places in the order "
                    "of laying are next to each other, and both are too long."
                )


def _of_support(name: str, place: Position, kind: Kind, on: list[Box]) -> Iterator[str]:
    if not on:
        return
    for other, middle, one in on:
        if max(_gaps(place[:2], kind, middle, one)) >= 0:
            yield f"The element '{name}' does not reach '{other}', which is to carry it: it would hang in the air."
            return
    for (other, middle, one), (another, its_middle, its_kind) in combinations(on, 2):
        if _gaps(middle, one, its_middle, its_kind)[0] < -CLOSE:
            yield f"The element '{name}' lies on '{other}' and '{another}', which must stand one after the other in x."
            return
    tops = [middle[2] + one.size[2] / 2 for _, middle, one in on]
    if max(tops) - min(tops) > LEANING:
        yield f"The element '{name}' would lean: what carries it differs by {max(tops) - min(tops):.3f} m in height."
    for axis in (0, 1):
        ends = [
            (
                max(middle[axis] - one.size[axis] / 2, place[axis] - kind.size[axis] / 2),
                min(middle[axis] + one.size[axis] / 2, place[axis] + kind.size[axis] / 2),
            )
            for _, middle, one in on
        ]
        if not min(low for low, _ in ends) < place[axis] < max(high for _, high in ends):
            yield f"The element '{name}' would tip over: its middle is not between what carries it."
            return


def _of_lengths(plan: Plan, box: Box, earlier: Box) -> Iterator[str]:
    """Whether there is room for what the lengths of elements vary by between one that lies still and another."""
    (name, place, kind), (other, its_place, its_kind) = box, earlier
    gaps = _gaps(place, kind, its_place, its_kind)
    is_fixed = plan.elements[name].at is not None or plan.elements[other].at is not None
    if not is_fixed or plan.elements[name].beside == other or max(gaps[1:]) > -CLOSE or gaps[0] < -CLOSE:
        return
    varies = sum(_strays(plan, one) + of.deviations[0] / 2 for one, of in ((name, kind), (other, its_kind)))
    if gaps[0] < varies:
        yield (
            f"The elements '{other}' and '{name}' are {1000 * max(gaps[0], 0):.1f} mm apart, and what elements differ "
            f"in length adds up to {1000 * varies:.1f} mm there: lay '{name}' beside '{other}', or farther away."
        )


def _strays(plan: Plan, name: str) -> float:
    """How far in x an element's middle may be off its drawn place, because lengths vary, in metres."""
    element = plan.elements[name]
    if element.at is not None:
        return 0.0
    if element.beside is None:
        return max(_strays(plan, other) for other in element.on)
    ends = [KINDS[plan.elements[one].kind].deviations[0] / 2 for one in (name, element.beside)]
    return _strays(plan, element.beside) + sum(ends)


def _of_earlier(
    name: str,
    place: Position,
    kind: Kind,
    other: str,
    its_place: Position,
    its_kind: Kind,
) -> Iterator[str]:
    """What stands between an element and one that is laid before it."""
    gaps = _gaps(place, kind, its_place, its_kind)
    if max(gaps) < -CLOSE:
        yield f"The elements '{other}' and '{name}' are in one place."
        return
    if max(gaps[:2]) < -CLOSE and its_place[2] > place[2]:
        yield f"The element '{name}' lies below '{other}', which is laid before it."
        return
    tips = place[2] + kind.size[2] / 2 - HELD_BELOW - TIPS
    is_high = its_place[2] + its_kind.size[2] / 2 > tips
    along = abs(place[0] - its_place[0]) - (FINGER_WIDTH + its_kind.size[0]) / 2
    across = abs(place[1] - its_place[1]) - its_kind.size[1] / 2
    if is_high and along < 0 and across < JAWS:
        yield f"There is no room for the fingers at '{name}' beside '{other}': {JAWS:.3f} m from its middle, in y."
