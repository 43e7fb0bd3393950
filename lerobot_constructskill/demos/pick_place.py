"""The six-phase expert of every pick-and-place task: above, down, grasp, lift, carry, release."""

from dataclasses import dataclass, replace

import numpy as np

from lerobot_constructskill.contract import GRIPPER_CLOSED, GRIPPER_OPEN, ROBOT_BASE, highest_tcp
from lerobot_constructskill.demos.expert import Advice, ExpertConfig, ExpertProgress, Phase
from lerobot_constructskill.demos.state import GROUNDED, PrivilegedState

GRAVITY = 9.81  # m/s2

ABOVE_TOP = 0.02
"""Height over the object's top at which the jaws wait to be aligned, in metres."""

AROUND = 0.005
"""Height of the TCP over the object's top from which down the finger tips, 9 mm below it, are around the object."""

OVERHEAD = 0.03
"""Horizontal distance to the grasp within which the hand goes down, in metres."""

RISEN = 0.02
"""Height in metres above an obstacle at which the hand begins to move sideways; twice as high it only does that."""

OFF_CENTRE = 0.03
"""Distance in metres off the middle at which an object on the ground is let go and taken again."""

NEAREST = 0.25
"""Distance in metres from the robot's base within which the hand cannot point down."""

PHASES = tuple(Phase)
GRIPPER = {
    phase: GRIPPER_CLOSED if phase in (Phase.GRASP, Phase.LIFT, Phase.CARRY) else GRIPPER_OPEN for phase in Phase
}


@dataclass(frozen=True)
class PickPlaceExpert:
    """Proportional control toward each phase's target; a phase ends at a distance or after a dwell.

    An expert that demonstrates keeps its progress, so that it goes through six phases in order. When a learner acts
    there is no progress: the learner pushes or drops objects, holds them off their centre, or has put them into
    the bin. `advise` reads the phase from the state alone.
    """

    config: ExpertConfig

    def start(self, state: PrivilegedState) -> ExpertProgress:
        return ExpertProgress(PHASES[0], 0, state.tcp, state.number)

    def act(self, state: PrivilegedState, progress: ExpertProgress) -> tuple[np.ndarray, Phase, ExpertProgress | None]:
        own = state.at(progress.number)
        while self._is_over(own, progress):
            progress = replace(progress, phase=PHASES[PHASES.index(progress.phase) + 1], steps=0, anchor=own.tcp)
        action = self._action(own, progress).astype(np.float32)
        after = replace(progress, steps=progress.steps + 1)
        if not self._is_last(own, after):
            return action, progress.phase, after
        # With the next placement it begins anew; one that it missed it does not mend.
        goes_on = state.number != progress.number and not state.is_done
        return action, progress.phase, self.start(state) if goes_on else None

    def _is_last(self, state: PrivilegedState, after: ExpertProgress) -> bool:
        """Whether the demonstration is over with the action that led to `after`."""
        return after.phase is PHASES[-1] and after.steps >= self.config.release_dwell

    def _action(self, state: PrivilegedState, progress: ExpertProgress) -> np.ndarray:
        return np.array([*self._translation(state, progress), GRIPPER[progress.phase]])

    def _is_over(self, state: PrivilegedState, progress: ExpertProgress) -> bool:
        """Whether the phase has ended and the next one begins; RELEASE is the last."""
        if progress.phase is Phase.GRASP:
            return progress.steps >= self.config.grasp_dwell
        if progress.phase is Phase.RELEASE:
            return False
        return bool(np.linalg.norm(self._error(state, progress)) < self.config.threshold)

    def _translation(self, state: PrivilegedState, progress: ExpertProgress) -> np.ndarray:
        if progress.phase in (Phase.GRASP, Phase.RELEASE):
            return np.zeros(3)
        if progress.phase in (Phase.LIFT, Phase.CARRY):
            moved = self._toward(self._way(self._error(state, progress), state), self.config.load_max_step)
            return moved + self._weight_compensation(state)
        return self._toward(self._way(self._waypoint(state, progress) - state.tcp, state), self.config.max_step)

    def _way(self, error: np.ndarray, state: PrivilegedState) -> np.ndarray:
        """Which way to go to end an error, (3,) metres: straight."""
        return error

    def _weight_compensation(self, state: PrivilegedState) -> np.ndarray:
        return np.array([0, 0, self.config.compliance * (GRAVITY * state.object_mass[0])])

    def _toward(self, error: np.ndarray, longest: float) -> np.ndarray:
        return np.clip(self.config.gain * error, -longest, longest)

    def _error(self, state: PrivilegedState, progress: ExpertProgress) -> np.ndarray:
        """What lies between the state and the end of the phase, (3,) metres."""
        if progress.phase is Phase.CARRY:
            return self._carry_error(state)
        return self._target(state, progress) - state.tcp

    def _target(self, state: PrivilegedState, progress: ExpertProgress) -> np.ndarray:
        """Where the end effector should go in this phase, (3,) metres."""
        match progress.phase:
            case Phase.PREGRASP:
                return self._grasp_point(state) + [0, 0, self.config.pregrasp_clearance]
            case Phase.DESCEND:
                return self._grasp_point(state)
            case Phase.LIFT:
                lifted = progress.anchor + [0, 0, self.config.lift_height]
                return np.array([*lifted[:2], min(lifted[2], self._highest(lifted))])
        raise RuntimeError(f"{progress.phase} has no target.")

    def _grasp_point(self, state: PrivilegedState) -> np.ndarray:
        return state.object_pose[:3] + [0, 0, state.object_size[2] / 2 - self.config.finger_depth]

    def _waypoint(self, state: PrivilegedState, progress: ExpertProgress) -> np.ndarray:
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
        return highest_tcp(np.hypot(*(point[:2] - ROBOT_BASE[:2])))

    def _carry_error(self, state: PrivilegedState) -> np.ndarray:
        """From the hand to the point over the bin's centre where the object is `release_clearance` above the rim."""
        below_tcp = state.object_size[2] - self.config.finger_depth
        above = state.rim + self.config.release_clearance + below_tcp
        return np.array([*state.bin_position[:2], above]) - state.tcp

    # Advice: the phase of a state and its action, without progress, as a learner's states need it

    def advise(self, state: PrivilegedState) -> Advice:
        if state.is_held:
            action, phase, hopeless = *self._carry_on(state), False
        elif self._is_there(state):
            # The hand moves as RELEASE says once the fingers are open.
            action, phase, hopeless = self._act_in(Phase.RELEASE, state) * state.is_open, Phase.RELEASE, False
            action[-1] = GRIPPER_OPEN
        elif hopeless := not self._can_take(state):
            action, phase = self._wait(state), Phase.PREGRASP
        else:
            action, phase = self._fetch(state)
        return Advice(action.astype(np.float32), phase, hopeless)

    # With the object in the hand

    def _carry_on(self, state: PrivilegedState) -> tuple[np.ndarray, Phase]:
        if self._is_at_receptacle(state):
            return self._act_in(Phase.RELEASE, state), Phase.RELEASE
        if state.underside < GROUNDED and self._is_off_centre(state):
            return self._straight_up(state), Phase.PREGRASP
        rising = self._share_to_rise(state)
        lift, carry = (self._act_in(phase, state) for phase in (Phase.LIFT, Phase.CARRY))
        return rising * lift + (1 - rising) * carry, Phase.LIFT if rising > 0.5 else Phase.CARRY

    def _share_to_rise(self, state: PrivilegedState) -> float:
        """How much a held object has to rise before it goes to the bin, 0 to 1.

        Far from the bin it goes as high as it was lifted, and comes down on the way, as a demonstration's does.
        """
        error = self._carry_error(state)
        near = (state.bin_interior + state.object_size)[:2] / 2 + RISEN
        height = max(0.0, (abs(error[:2]) - near).max())
        # Far out the arm may not reach as high as the release, and has to come nearer first.
        lifted = self._target(state, self._beginning(Phase.LIFT, state))
        most = self._highest(state.tcp) if error[2] > 0 else lifted[2]
        lacking = min(error[2] + height, most - self.config.threshold - state.tcp[2])
        return float(np.clip(lacking / (RISEN + height / 2), 0, 1))

    # With empty hands

    def _fetch(self, state: PrivilegedState) -> tuple[np.ndarray, Phase]:
        grasp = self._grasp_point(state)
        above = state.tcp[2] > state.top + RISEN / 2
        around = abs((grasp - state.tcp) @ state.jaw_axis) < state.play(state.skew)
        is_near = np.linalg.norm((grasp - state.tcp)[:2]) < OVERHEAD and self._is_turned(state)
        if is_near and state.is_open and (above or around):
            at_grasp = self._is_over(state, self._beginning(Phase.DESCEND, state))
            phase = Phase.GRASP if at_grasp else Phase.DESCEND
            return self._act_in(phase, state), phase
        rising = float(np.clip((self._obstacle(state, grasp) + 2 * RISEN - state.tcp[2]) / RISEN, 0, 1))
        over = self._act_in(Phase.PREGRASP, state)
        return rising * self._straight_up(state) + (1 - rising) * over, Phase.PREGRASP

    def _obstacle(self, state: PrivilegedState, grasp: np.ndarray) -> float:
        """Height in metres of what stands in the way of an empty hand that goes to `grasp`."""
        return state.obstacle if state.crosses_bin(grasp) else state.top

    def _straight_up(self, state: PrivilegedState) -> np.ndarray:
        action = 0 * self._act_in(Phase.PREGRASP, state)
        action[2], action[-1] = self.config.max_step, GRIPPER_OPEN
        return action

    def _wait(self, state: PrivilegedState) -> np.ndarray:
        """Open, and rise until the hand is out of the way."""
        action = self._straight_up(state)
        height = state.obstacle + self.config.pregrasp_clearance
        action[2] = np.clip(height - state.tcp[2], 0, self.config.max_step)
        return action

    # What a state is

    def _can_take(self, state: PrivilegedState) -> bool:
        """Whether the object stands within reach and the jaws fit around it."""
        grasp = self._grasp_point(state)
        radius = np.hypot(*(grasp[:2] - ROBOT_BASE[:2]))
        within = radius > NEAREST and self._highest(grasp) > state.top + RISEN
        fits = state.stands and not state.is_bent and state.play(self._skew(state)) > 0
        return bool(within and fits and not state.is_blocked(grasp))

    def _skew(self, state: PrivilegedState) -> float:
        """Angle in radians between the jaws and the object at the moment when the jaws close."""
        return state.skew

    def _is_turned(self, state: PrivilegedState) -> bool:
        """Whether the jaws are aligned with the object as far as the action can align them."""
        return True

    def _is_there(self, state: PrivilegedState) -> bool:
        """Whether the object is where it belongs, or falls there."""
        away = abs(state.object_pose[:3] - state.bin_position)
        return bool((away[:2] < state.bin_interior[:2] / 2).all())

    def _is_at_receptacle(self, state: PrivilegedState) -> bool:
        """Whether a held object is to be let go: at the release point, or deep enough in the bin."""
        away = abs(state.object_pose[:2] - state.bin_position[:2])
        is_inside = (away < (state.bin_interior - state.object_size)[:2] / 2).all()
        is_inserted = is_inside and state.underside < float(state.rim)
        return bool(is_inserted or np.linalg.norm(self._carry_error(state)) < self.config.threshold)

    def _is_off_centre(self, state: PrivilegedState) -> bool:
        return bool(np.linalg.norm((self._grasp_point(state) - state.tcp)[:2]) > OFF_CENTRE)

    def _act_in(self, phase: Phase, state: PrivilegedState) -> np.ndarray:
        return self._action(state, self._beginning(phase, state)).astype(float)

    def _beginning(self, phase: Phase, state: PrivilegedState) -> ExpertProgress:
        """The progress of a phase that has just begun, with the object taken from the ground where the hand is."""
        height = state.object_size[2] - self.config.finger_depth
        return ExpertProgress(phase, 0, np.array([*state.tcp[:2], height]))
