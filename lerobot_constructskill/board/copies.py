"""Finds copies: episodes of one task from one start that place with nearly the same actions, as they are executed.

The closest episodes of two training seeds on the board differ by 3.0e-3 in the median step, and the closest of one
that was shown other light by 1.8e-3 (tests/board/test_copies.py). A copy keeps to what it copies, or it ends
otherwise.
"""

from collections.abc import Callable, Iterable, Sequence
from itertools import groupby

import numpy as np

from lerobot_constructskill.contract import FULL_ACTION, get_task
from lerobot_constructskill.envs.actions import within_reach
from lerobot_constructskill.envs.recording import Episode

TOLERANCE = 5e-4
"""Largest difference of a channel between two steps that count as the same: of the 0.1 m or rad that a step may ask
for, so 0.05 mm."""

SHARE = 0.5
"""Two episodes are nearly the same if this share of the longer one's steps are, counted from the start or the end."""


def near_copy[Kind: Episode](
    claims: Iterable[Kind],
    others: Iterable[Kind],
    may_be: Callable[[Kind, Kind], bool],
    tolerance: float = TOLERANCE,
) -> tuple[Kind, Kind] | None:
    """A placing episode of `claims` that is nearly one of `others`, and that one; None where there is none.

    Args:
        may_be: whether two episodes may be the same.
    """
    known = _by_start(others)
    for where, own in _by_start(claims).items():
        if where in known and (found := _first_near(own, known[where], may_be, tolerance)):
            return found
    return None


def _by_start[Kind: Episode](claims: Iterable[Kind]) -> dict[tuple[str, int], list[Kind]]:
    placed = sorted((one for one in claims if one.placed), key=_where)
    return {where: list(own) for where, own in groupby(placed, key=_where)}


def _where(claim: Episode) -> tuple[str, int]:
    return claim.task, claim.evaluation_seed


def _first_near[Kind: Episode](
    own: list[Kind], others: list[Kind], may_be: Callable[[Kind, Kind], bool], tolerance: float
) -> tuple[Kind, Kind] | None:
    longest = max(one.steps for one in (*own, *others))
    there = _stacked(others, longest)
    for claim, *here in zip(own, *_stacked(own, longest), strict=True):
        shares = [_same(one, all_of_them, tolerance) for one, all_of_them in zip(here, there, strict=True)]
        enough = SHARE * np.maximum(claim.steps, [other.steps for other in others])
        for number in np.flatnonzero(np.maximum(*shares) >= enough):
            if not may_be(claim, others[number]):
                return claim, others[number]
    return None


def _stacked(claims: Sequence[Episode], longest: int) -> tuple[np.ndarray, np.ndarray]:
    """What was executed, (claims, longest, 7), with NaN after each end, and with NaN before each start."""
    first = np.full((len(claims), longest, len(FULL_ACTION)), np.nan, np.float32)
    last = first.copy()
    for number, claim in enumerate(claims):
        executed = within_reach(claim.executed, get_task(claim.task, claim.action).action_names)
        executed[:, -1] = 0  # jaws that hold close no further, whatever is asked: it would hide a copy
        first[number, : claim.steps] = last[number, longest - claim.steps :] = executed
    return first, last


def _same(one: np.ndarray, others: np.ndarray, tolerance: float) -> np.ndarray:
    """In how many steps an episode, (steps, 7), is nearly each of others, (others, steps, 7); NaN is near nothing."""
    return (np.abs(others - one) <= tolerance).all(axis=2).sum(axis=1)
