"""The expert of walls: it lays one element after the other, and carries each over everything that stands there."""

from dataclasses import dataclass

import numpy as np

from lerobot_constructskill.contract import ROBOT_BASE
from lerobot_constructskill.demos.pick_place import NEAREST
from lerobot_constructskill.demos.precise import PreciseExpert
from lerobot_constructskill.demos.state import PrivilegedState

FULL_LEVER = 0.65
"""Distance in metres from the robot's base at which `ExpertConfig.compliance` was measured."""

ROUND = 0.40
"""Distance in metres at which the hand goes round the robot's base."""

PASSING = 0.01
"""Metres by which a way comes nearer to the robot's base than its ends are, if it passes it."""

TOUCHING = 0.002
"""Height in metres over the floor from which down an element's lowest corner carries a part of its weight."""


@dataclass(frozen=True)
class LayingExpert(PreciseExpert):
    """Begins anew with the next placement, and keeps out of the way of all that stands."""

    release_gap = 0.002
    _clear_height = 0.10
    _pushed_in = 0.0  # a wall has no rim

    def _way(self, error: np.ndarray, state: PrivilegedState) -> np.ndarray:
        """Round the robot's base where the straight way leads too near it, as to an element that waits beside it."""
        here, goal = (state.tcp - ROBOT_BASE)[:2], (state.tcp - ROBOT_BASE + error)[:2]
        # Steps are limited along each axis, so a long way begins at 45 degrees.
        corner = here + np.sign(error[:2]) * abs(error[:2]).min()
        closest = min(_closest(here, corner), _closest(corner, goal), key=np.linalg.norm)
        distance = float(np.linalg.norm(closest))
        if distance > NEAREST or distance > min(np.linalg.norm(here), np.linalg.norm(goal)) - PASSING:
            return error
        outward = closest / distance if closest[0] > 0 else np.array([1.0, 0.0])  # never behind the robot
        return np.array([*(outward * ROUND - here), error[2]])

    def _underside(self, state: PrivilegedState) -> float:
        """Height of the middle of the underside in metres.

        An element hangs a few degrees off level in the jaws. Pressed on what carries it, it turns between them; let go
        from its lowest corner, it would fall to one side.
        """
        return state.object_pose[2] - state.object_size[2] / 2

    def _carry_error(self, state: PrivilegedState) -> np.ndarray:
        """From the object's centre to the point where its underside is `release_clearance` above all others, (3,)."""
        above = _highest(float(state.rim), state) + self.config.release_clearance + state.object_size[2] / 2
        return np.array([*state.bin_position[:2], above]) - state.object_pose[:3]

    def _hold_up(self, step: np.ndarray, state: PrivilegedState) -> np.ndarray:
        # What stands on its lowest corner is carried by what is below: only then can it be pressed down.
        carried = float(np.clip((super()._underside(state) - state.floor) / TOUCHING, 0, 1))
        return step + carried * (super()._hold_up(step, state) - step)

    def _weight_compensation(self, state: PrivilegedState) -> np.ndarray:
        """As much of it as the arm sags there: with the square of the lever, and hardly at all near the base."""
        lever = np.hypot(*(state.tcp - ROBOT_BASE)[:2]) / FULL_LEVER
        return super()._weight_compensation(state) * min(lever, 1.0) ** 2

    # Advice

    def _obstacle(self, state: PrivilegedState, grasp: np.ndarray) -> float:
        return _highest(state.obstacle, state)


def _closest(start: np.ndarray, end: np.ndarray) -> np.ndarray:
    """The point of a way that is closest to the origin, (2,)."""
    way = end - start
    return start + float(np.clip(-(start @ way) / max(way @ way, 1e-9), 0, 1)) * way


def _highest(height: float, state: PrivilegedState) -> float:
    """`height`, or that of the highest of all other objects, in metres."""
    return max([height, *(other.top for other in state.others())])
