"""The expert of tasks with little play: it watches the object, not only the hand, and lowers it into place.

The six phases are the pick-and-place expert's. CARRY ends over the receptacle; RELEASE aligns the object,
lowers it and opens the jaws; noise has no part in it unless `noise.release_sigma` says so.
"""

from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from lerobot_constructskill.contract import GRIPPER_CLOSED, GRIPPER_OPEN, ROBOT_BASE
from lerobot_constructskill.demos.expert import ExpertProgress, Phase
from lerobot_constructskill.demos.pick_place import GRAVITY, PickPlaceExpert
from lerobot_constructskill.demos.state import OPENED, PrivilegedState

TIP_CLEARANCE = 0.02
"""Distance in metres from the TCP down to the rim that open fingers keep; their tips are 9 mm below it."""

CENTRED = np.array([0.003, 0.003, 0.006])
"""Largest error of the hand in metres with which the jaws close: an object held off its centre, or by less of the
fingers, swings between them when it is lifted."""

DRAWN_IN = 0.00032
"""Translation away from the base asked for per newton of held weight, in m/N: an arm that sags draws the hand in."""

ALIGNED = 0.003
"""Metres by which closing jaws move the hand."""

ALIGNING_GAIN = 1.2
"""Above 1.5 the held object rocks between the fingers, two steps to a swing."""

LOWERING_STEP = 0.008
"""Largest translation asked for per axis and step in RELEASE, in metres."""

FINEST, COARSEST = 0.0008, 0.005
"""Bounds on the error in metres that RELEASE accepts before it lowers; in between, half the play."""

INSERTED = 0.003
"""Depth in metres below the rim from which on there is no way but down. Before it, an object that the rim has pushed
aside rises and comes again."""

FUNNEL = 0.15
"""Metres off the middle that RELEASE accepts in addition, for each metre left to the rim. An arm that aligns while it
comes down is in the middle before it arrives; one that waits above until it is aligned teaches a policy to wait."""

YAW_STEP, YAW_TOLERANCE = 0.1, 0.03
"""Largest rotation asked for in a step, and the error at which a phase may end, in radians."""

SEATED = 0.008
"""Height in metres over the floor of the receptacle at which an object that falls is as good as there."""


@dataclass(frozen=True)
class PreciseExpert(PickPlaceExpert):
    """Closes the loop on the object's pose from CARRY on."""

    release_gap: ClassVar[float] = 0.003
    """Height in metres over the floor of the receptacle from which an object may drop."""

    _pushed_in: ClassVar[float] = COARSEST
    """Metres off the middle from which a rim pushes an object in."""

    def _is_over(self, state: PrivilegedState, progress: ExpertProgress) -> bool:
        is_centred = (abs(self._grasp_point(state) - state.tcp) < CENTRED).all()
        return super()._is_over(state, progress) and bool(is_centred or progress.phase is not Phase.DESCEND)

    def _is_last(self, state: PrivilegedState, after: ExpertProgress) -> bool:
        """Whether the hand has risen well clear of the object."""
        risen = state.tcp[2] - (state.object_pose[2] + state.object_size[2] / 2)
        return after.phase is Phase.RELEASE and risen > self._clear_height

    @property
    def _clear_height(self) -> float:
        """Height in metres of the TCP over a placed object at which the hand is done with it."""
        return self.config.pregrasp_clearance

    def _action(self, state: PrivilegedState, progress: ExpertProgress) -> np.ndarray:
        return self._release(state) if progress.phase is Phase.RELEASE else super()._action(state, progress)

    def _carry_error(self, state: PrivilegedState) -> np.ndarray:
        """From the object's centre to the point where its underside is `release_clearance` above the rim, (3,)."""
        above = state.rim + self.config.release_clearance + state.object_size[2] / 2
        return np.array([*state.bin_position[:2], above]) - state.object_pose[:3]

    def _release(self, state: PrivilegedState) -> np.ndarray:
        # Down to the floor, or to where the fingers would meet the rim.
        lowest = max(state.floor, state.rim + TIP_CLEARANCE - (state.object_size[2] - self.config.finger_depth))
        gap = lowest - self._underside(state)
        if min(state.fingers) > OPENED:
            return np.array([0, 0, self.config.max_step, GRIPPER_OPEN])
        if gap > -self.release_gap:
            return np.array([0, 0, 0, GRIPPER_OPEN])
        error = self._carry_error(state)
        haste = self._haste(state, error)
        error[2] = haste * (gap - self.release_gap) + (1 - haste) * error[2]
        step = np.clip(ALIGNING_GAIN * error, -LOWERING_STEP, LOWERING_STEP)
        return np.array([*self._hold_up(step, state), GRIPPER_CLOSED])

    def _hold_up(self, step: np.ndarray, state: PrivilegedState) -> np.ndarray:
        """The translation that moves an arm by `step`, (3,) metres, which the held object draws down and in."""
        radius = (state.tcp - ROBOT_BASE) * [1, 1, 0]
        outward = DRAWN_IN * GRAVITY * state.object_mass[0] * radius / np.linalg.norm(radius)
        return step + self._weight_compensation(state) + outward

    def _haste(self, state: PrivilegedState, error: np.ndarray) -> float:
        """How fast to lower, 0 to 1: not at all outside a funnel over the opening, and gradually from its wall on."""
        gap = self._underside(state) - state.rim
        if gap < -INSERTED:
            return 1.0
        accepted = np.clip(_play(state) / 2, FINEST, COARSEST) + FUNNEL * max(gap, 0)
        return float(np.clip(1.5 - abs(error[:2]) / accepted, 0, 1).min())

    def _underside(self, state: PrivilegedState) -> float:
        """Height of the object's lowest corner in metres, in float32 as recorded demonstrations have it."""
        w, x, y, z = state.object_pose[3:]
        ends = np.array([2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)])
        return state.object_pose[2] - abs(ends) @ state.object_size / 2

    # Advice

    def _is_there(self, state: PrivilegedState) -> bool:
        is_over = self._is_over_opening(state, self._carry_error(state))
        return bool(state.stands and is_over and state.underside < state.floor + SEATED)

    def _is_over_opening(self, state: PrivilegedState, error: np.ndarray) -> bool:
        return bool((abs(error[:2]) < np.maximum(_play(state), self._pushed_in)).all())

    def _is_at_receptacle(self, state: PrivilegedState) -> bool:
        """RELEASE aligns above the opening; an object that has come down beside it rises again."""
        error = self._carry_error(state)
        if state.underside < state.rim:
            return self._is_over_opening(state, error)
        return bool(np.linalg.norm(error[:2]) < self.config.threshold and error[2] > -self.config.threshold)

    def _is_off_centre(self, state: PrivilegedState) -> bool:
        error = abs(self._grasp_point(state) - state.tcp)
        return bool((error > 2 * CENTRED + ALIGNED).any())


@dataclass(frozen=True)
class TurningExpert(PreciseExpert):
    """Turns the jaws to the object and the object to the receptacle, whose faces are alike after half a turn."""

    def _is_over(self, state: PrivilegedState, progress: ExpertProgress) -> bool:
        turns = progress.phase in (Phase.PREGRASP, Phase.CARRY)
        is_turned = abs(self._yaw_error(state, progress.phase)) < YAW_TOLERANCE
        return super()._is_over(state, progress) and (is_turned or not turns)

    def _action(self, state: PrivilegedState, progress: ExpertProgress) -> np.ndarray:
        *translation, gripper = super()._action(state, progress)
        turn = np.clip(self._yaw_error(state, progress.phase), -YAW_STEP, YAW_STEP)
        return np.array([*translation, turn, gripper])

    def _yaw_error(self, state: PrivilegedState, phase: Phase) -> float:
        """How far the jaws have to turn in this phase, in radians."""
        yaw = yaw_of(state.object_pose)
        match phase:
            case Phase.PREGRASP | Phase.DESCEND:
                jaws = np.arctan2(-state.jaw_axis[0], state.jaw_axis[1])
                return _half_turn(yaw - jaws)
            case Phase.LIFT | Phase.CARRY:
                return _half_turn(-yaw) * (phase is Phase.CARRY)
        return 0.0

    # Advice

    def _skew(self, state: PrivilegedState) -> float:
        return 0.0

    def _is_there(self, state: PrivilegedState) -> bool:
        return PickPlaceExpert._is_there(self, state)  # its bin is wide: the object need not stand in the middle

    def _is_turned(self, state: PrivilegedState, phase: Phase = Phase.PREGRASP) -> bool:
        return abs(self._yaw_error(state, phase)) < YAW_STEP

    def _is_at_receptacle(self, state: PrivilegedState) -> bool:
        is_turned = self._is_turned(state, Phase.CARRY)
        return super()._is_at_receptacle(state) and (is_turned or state.underside < float(state.rim))


def yaw_of(pose: np.ndarray) -> np.ndarray:
    """Turn of poses (..., 7) about the vertical, in radians from -pi to pi."""
    w, x, y, z = np.moveaxis(pose[..., 3:], -1, 0)
    return np.arctan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))


def _half_turn(angle: float) -> float:
    """`angle` in radians, less whole half turns: within a quarter turn of zero."""
    return (angle + np.pi / 2) % np.pi - np.pi / 2


def _play(state: PrivilegedState) -> np.ndarray:
    """Room beside the object in x and y, (2,) metres; below 0 where it has a shoulder that stays outside."""
    return (state.bin_interior - state.object_size)[:2] / 2
