"""The six-phase expert of every pick-and-place task: above, down, grasp, lift, carry, release."""

from dataclasses import dataclass, replace

import numpy as np

from lerobot_constructskill.contract import GRIPPER_CLOSED, GRIPPER_OPEN, ROBOT_BASE
from lerobot_constructskill.demos.advice import Memoryless
from lerobot_constructskill.demos.expert import ExpertConfig, Phase, Progress
from lerobot_constructskill.demos.state import PrivilegedState

GRAVITY = 9.81  # m/s2

ABOVE_TOP = 0.02
"""Height over the object's top at which the jaws wait to be aligned, in metres."""

AROUND = 0.005
"""Height of the TCP over the object's top from which down the finger tips, 9 mm below it, are around the object."""

SHOULDER_HEIGHT, WRIST_RADIUS, WRIST_HEIGHT = 0.333, 0.088, 0.2104
"""Of the Panda with its hand pointing down, in metres: the shoulder above the base, and the wrist above the TCP and
nearer to the base (Franka's kinematic parameters)."""

REACH = 0.66
"""Longest distance from shoulder to wrist in metres; 0.06 short of the stretched arm, near which IK fails."""

PHASES = tuple(Phase)
GRIPPER = {
    phase: GRIPPER_CLOSED if phase in (Phase.GRASP, Phase.LIFT, Phase.CARRY) else GRIPPER_OPEN for phase in Phase
}


@dataclass(frozen=True)
class PickPlaceExpert(Memoryless):
    """Proportional control toward each phase's target; a phase ends at a distance or after a dwell."""

    config: ExpertConfig

    def start(self, state: PrivilegedState) -> Progress:
        return Progress(PHASES[0], 0, state.tcp)

    def act(self, state: PrivilegedState, progress: Progress) -> tuple[np.ndarray, Phase, Progress | None]:
        while self._is_over(state, progress):
            progress = Progress(PHASES[PHASES.index(progress.phase) + 1], 0, state.tcp)
        action = self._action(state, progress).astype(np.float32)
        after = replace(progress, steps=progress.steps + 1)
        return action, progress.phase, None if self._is_last(state, after) else after

    def _is_last(self, state: PrivilegedState, after: Progress) -> bool:
        """Whether the demonstration is over with the action that led to `after`."""
        return after.phase is PHASES[-1] and after.steps >= self.config.release_dwell

    def _action(self, state: PrivilegedState, progress: Progress) -> np.ndarray:
        return np.array([*self._translation(state, progress), GRIPPER[progress.phase]])

    def _is_over(self, state: PrivilegedState, progress: Progress) -> bool:
        """Whether the phase has ended and the next one begins; RELEASE is the last."""
        if progress.phase is Phase.GRASP:
            return progress.steps >= self.config.grasp_dwell
        if progress.phase is Phase.RELEASE:
            return False
        return bool(np.linalg.norm(self._target(state, progress) - state.tcp) < self.config.threshold)

    def _translation(self, state: PrivilegedState, progress: Progress) -> np.ndarray:
        if progress.phase in (Phase.GRASP, Phase.RELEASE):
            return np.zeros(3)
        error = self._waypoint(state, progress) - state.tcp
        if progress.phase not in (Phase.LIFT, Phase.CARRY):
            return self._toward(error, self.config.max_step)
        return self._toward(error, self.config.load_max_step) + self._weight_compensation(state)

    def _weight_compensation(self, state: PrivilegedState) -> np.ndarray:
        return np.array([0, 0, self.config.compliance * (GRAVITY * state.object_mass[0])])

    def _toward(self, error: np.ndarray, longest: float) -> np.ndarray:
        return np.clip(self.config.gain * error, -longest, longest)

    def _target(self, state: PrivilegedState, progress: Progress) -> np.ndarray:
        """Where the end effector should go in this phase, (3,) metres."""
        match progress.phase:
            case Phase.PREGRASP:
                return self._grasp_point(state) + [0, 0, self.config.pregrasp_clearance]
            case Phase.DESCEND:
                return self._grasp_point(state)
            case Phase.LIFT:
                return _within_reach(progress.anchor + [0, 0, self.config.lift_height])
            case Phase.CARRY:
                return self._release_point(state)
        raise RuntimeError(f"{progress.phase} has no target.")

    def _grasp_point(self, state: PrivilegedState) -> np.ndarray:
        return state.object_pose[:3] + [0, 0, state.object_size[2] / 2 - self.config.finger_depth]

    def _waypoint(self, state: PrivilegedState, progress: Progress) -> np.ndarray:
        """The phase's target, or a point above the object until the jaws are over it: a finger that lands tips it."""
        target = self._target(state, progress)
        if progress.phase is not Phase.DESCEND:
            return target
        top = target[2] + self.config.finger_depth
        misaligned = abs((target - state.tcp) @ state.jaw_axis)
        if misaligned < self.config.align_tolerance or state.tcp[2] < top + AROUND:
            return target
        return np.array([*target[:2], top + ABOVE_TOP])

    def _highest(self, point: np.ndarray) -> float:
        """Height that the hand reaches over `point`, in metres."""
        return float(_within_reach(np.array([*point[:2], np.inf]))[2])

    def _release_point(self, state: PrivilegedState) -> np.ndarray:
        """Above the bin's centre, the object's underside `release_clearance` above the rim."""
        below_tcp = state.object_size[2] - self.config.finger_depth
        return np.array([*state.bin_position[:2], state.rim + self.config.release_clearance + below_tcp])


def _within_reach(point: np.ndarray) -> np.ndarray:
    """`point`, (3,) metres, or the highest one below it that the arm reaches."""
    radius = np.hypot(*(point[:2] - ROBOT_BASE[:2])) - WRIST_RADIUS
    highest = SHOULDER_HEIGHT - WRIST_HEIGHT + np.sqrt(max(0.0, REACH**2 - radius**2))
    return np.array([*point[:2], min(point[2], highest)])
