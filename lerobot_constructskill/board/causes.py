"""Names what a failed episode lost, from its states and the last one from which the expert still places."""

from collections.abc import Sequence

import numpy as np

from lerobot_constructskill.board.recovered import Lost
from lerobot_constructskill.demos.expert import ExpertConfig
from lerobot_constructskill.demos.state import PrivilegedState

SOON = 3
"""Steps within which an open command takes the object from the jaws."""

AROUND = 10
"""Steps, half a second, within which what leaves closed jaws slips from a hold that was already lost."""

GRASPED = ExpertConfig().threshold
"""Distance in metres from the grasp point within which the expert closes the jaws; farther off is off centre."""

LOW = 0.01
"""Height in metres over the rim below which a held object is at the goal."""


def cause(states: Sequence[PrivilegedState], grippers: np.ndarray, last: int | None) -> Lost:
    """What an episode lost that did not place.

    Args:
        states: before each action and after the last, (steps + 1).
        grippers: the actions' gripper channel, (steps,).
        last: the last step from which the expert places; None if there is none.
    """
    end, moment = len(grippers), last or 0
    until = min(moment + AROUND, end)
    held = next((step for step in range(until, -1, -1) if states[step].is_held), None)
    if held is None or held < moment - SOON and moment < end:
        return _lost_free(states, moment)
    if held < end and held <= moment + SOON and _is_opened(grippers, held):
        return _lost_by_release(states[held])
    if moment == end:
        return Lost.TIME if held == end else _lost_in_hand(states, held, slips=True)
    return _lost_in_hand(states, held, slips=held < until and not _is_opened(grippers, held))


def _is_opened(grippers: np.ndarray, step: int) -> bool:
    """Whether the jaws were told to open when the hold whose last step this is ended."""
    return bool((grippers[max(0, step + 1 - SOON) : step + 1] > 0).any())


def _lost_free(states: Sequence[PrivilegedState], moment: int) -> Lost:
    """Of an object that nothing holds."""
    if not states[-1].stands:
        return Lost.TIPPED
    if moment == len(states) - 1:
        return Lost.NEVER_GRASPED
    moved = np.linalg.norm((states[-1].object_pose - states[moment].object_pose)[:2])
    return Lost.PUSHED if moved > GRASPED else Lost.HAND


def _lost_by_release(state: PrivilegedState) -> Lost:
    away, inside = _away(state), (state.bin_interior - state.object_size)[:2] / 2
    return Lost.BESIDE if _is_over(state) and not (away <= inside).all() else Lost.EARLY


def _lost_in_hand(states: Sequence[PrivilegedState], step: int, slips: bool) -> Lost:
    """Of an object that the jaws still hold in a step, or that slips from them then."""
    state = states[step]
    if _is_off_centre(states, step):
        return Lost.OFF_CENTRE
    if slips:
        return Lost.DROPPED
    if _is_over(state) and state.underside < state.rim + LOW:
        return Lost.JAMMED if (_away(state) < state.bin_interior[:2] / 2).all() else Lost.BESIDE
    return Lost.UNKNOWN if state.stands else Lost.TIPPED


def _away(state: PrivilegedState) -> np.ndarray:
    """Distance of object and goal in x and y, (2,) metres."""
    return abs(state.object_pose[:3] - state.bin_position)[:2]


def _is_over(state: PrivilegedState) -> bool:
    """Whether the object overlaps the outline of the goal."""
    return bool((_away(state) < (state.bin_interior + state.object_size)[:2] / 2).all())


def _is_off_centre(states: Sequence[PrivilegedState], step: int) -> bool:
    """Whether the hold that goes on in a step began off the grasp point."""
    while step > 0 and states[step - 1].is_held:
        step -= 1
    state = states[step]
    grasp = state.object_pose[:3] + [0, 0, state.object_size[2] / 2 - ExpertConfig().finger_depth]
    return bool(np.linalg.norm(grasp - state.tcp) > GRASPED)
