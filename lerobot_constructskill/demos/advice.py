"""Advice from the state alone: which phase a state belongs to, whoever brought it about, and that phase's action.

A demonstration's own expert keeps its progress, so that it goes through six phases in order. Where a learner drives,
there is no progress: bricks are pushed, dropped, held off their centre, or in the bin already.
"""

import numpy as np

from lerobot_constructskill.contract import GRIPPER_OPEN, ROBOT_BASE
from lerobot_constructskill.demos.expert import Advice, ExpertConfig, Phase, PrivilegedState, Progress
from lerobot_constructskill.demos.stance import GROUNDED, Stance

OVERHEAD = 0.03
"""Horizontal distance to the grasp within which the hand goes down, in metres."""

RISEN = 0.02
"""Metres above what is in the way at which a hand begins to move sideways; it takes as many again to do so fully."""

OFF_CENTRE = 0.03
"""Distance in metres off the middle at which an object on the ground is let go and taken again."""

NEAREST = 0.25
"""Distance in metres from the robot's base within which the hand cannot point down."""


class Memoryless:
    """`advise` for an expert of six phases, which says what each phase does in `_action`."""

    config: ExpertConfig

    def advise(self, state: PrivilegedState) -> Advice:
        stance = Stance(state)
        if stance.is_held:
            action, phase, hopeless = *self._carry_on(stance), False
        elif self._is_there(stance):
            action, phase, hopeless = self._let_go(stance), Phase.RELEASE, False
        elif hopeless := not self._can_take(stance):
            action, phase = self._wait(stance), Phase.PREGRASP
        else:
            action, phase = self._fetch(stance)
        return Advice(action.astype(np.float32), phase, hopeless)

    # With the object in the hand

    def _carry_on(self, stance: Stance) -> tuple[np.ndarray, Phase]:
        state = stance.state
        if self._is_at_receptacle(stance):
            return self._act_in(Phase.RELEASE, state), Phase.RELEASE
        if stance.underside < GROUNDED and self._is_off_centre(stance):
            return self._straight_up(stance), Phase.PREGRASP
        rising = self._share_to_rise(stance)
        lift, carry = (self._act_in(phase, state) for phase in (Phase.LIFT, Phase.CARRY))
        return rising * lift + (1 - rising) * carry, Phase.LIFT if rising > 0.5 else Phase.CARRY

    def _share_to_rise(self, stance: Stance) -> float:
        """How much a held object has to rise before it goes to the bin, 0 to 1.

        Far from the bin it goes as high as it was lifted, and comes down on the way, as a demonstration's does.
        """
        state, error = stance.state, self._release_error(stance)
        near = (state.bin_interior + state.object_size)[:2] / 2 + RISEN
        height = max(0.0, (abs(error[:2]) - near).max())
        # Far out the arm may not reach as high as the release, and has to come nearer first.
        most = self._highest(state.tcp) if error[2] > 0 else self._lifted(state)[2]
        lacking = min(error[2] + height, most - self.config.threshold - state.tcp[2])
        return float(np.clip(lacking / (RISEN + height / 2), 0, 1))

    def _lifted(self, state: PrivilegedState) -> np.ndarray:
        return self._target(state, self._beginning(Phase.LIFT, state))

    # With empty hands

    def _fetch(self, stance: Stance) -> tuple[np.ndarray, Phase]:
        state, grasp = stance.state, self._grasp_point(stance.state)
        above = state.tcp[2] > stance.top + RISEN / 2
        around = abs((grasp - state.tcp) @ state.jaw_axis) < stance.play(stance.skew)
        is_near = np.linalg.norm((grasp - state.tcp)[:2]) < OVERHEAD and self._is_turned(stance)
        if is_near and stance.is_open and (above or around):
            at_grasp = self._is_over(state, self._beginning(Phase.DESCEND, state))
            phase = Phase.GRASP if at_grasp else Phase.DESCEND
            return self._act_in(phase, state), phase
        rising = self._share_to_clear(stance, grasp)
        over = self._act_in(Phase.PREGRASP, state)
        return rising * self._straight_up(stance) + (1 - rising) * over, Phase.PREGRASP

    def _share_to_clear(self, stance: Stance, target: np.ndarray) -> float:
        """How much an empty hand has to rise before it moves sideways, 0 to 1."""
        obstacle = max(stance.top, stance.rim) if stance.crosses_bin(target) else stance.top
        return float(np.clip((obstacle + 2 * RISEN - stance.state.tcp[2]) / RISEN, 0, 1))

    def _let_go(self, stance: Stance) -> np.ndarray:
        """RELEASE's own action once the fingers are open."""
        action = self._act_in(Phase.RELEASE, stance.state) * stance.is_open
        action[-1] = GRIPPER_OPEN
        return action

    def _straight_up(self, stance: Stance) -> np.ndarray:
        action = 0 * self._act_in(Phase.PREGRASP, stance.state)
        action[2], action[-1] = self.config.max_step, GRIPPER_OPEN
        return action

    def _wait(self, stance: Stance) -> np.ndarray:
        """Open, and rise to where a hand is in nobody's way."""
        action = self._straight_up(stance)
        height = max(stance.top, stance.rim) + self.config.pregrasp_clearance
        action[2] = np.clip(height - stance.state.tcp[2], 0, self.config.max_step)
        return action

    # What a state is

    def _can_take(self, stance: Stance) -> bool:
        """Whether the object stands within reach and the jaws fit around it."""
        _state, grasp = stance.state, self._grasp_point(stance.state)
        radius = np.hypot(*(grasp[:2] - ROBOT_BASE[:2]))
        within = radius > NEAREST and self._highest(grasp) > stance.top + RISEN
        fits = stance.stands and not stance.is_bent and stance.play(self._skew(stance)) > 0
        return bool(within and fits and not stance.is_blocked(grasp))

    def _skew(self, stance: Stance) -> float:
        """How askew the jaws are when they come to close."""
        return stance.skew

    def _is_turned(self, stance: Stance) -> bool:
        return True

    def _is_there(self, stance: Stance) -> bool:
        """Whether the object is where it belongs, or falls there."""
        away = abs(stance.state.object_pose[:3] - stance.state.bin_position)
        return bool((away[:2] < stance.state.bin_interior[:2] / 2).all())

    def _is_at_receptacle(self, stance: Stance) -> bool:
        """Whether a held object is to be let go: at the release point, or deep enough in the bin."""
        state = stance.state
        away = abs(state.object_pose[:2] - state.bin_position[:2])
        inserted = (away < (state.bin_interior - state.object_size)[:2] / 2).all() and stance.underside < stance.rim
        return bool(inserted or np.linalg.norm(self._release_error(stance)) < self.config.threshold)

    def _release_error(self, stance: Stance) -> np.ndarray:
        """From the hand to where CARRY ends, (3,) metres."""
        return self._release_point(stance.state) - stance.state.tcp

    def _is_off_centre(self, stance: Stance) -> bool:
        error = (self._grasp_point(stance.state) - stance.state.tcp)[:2]
        return bool(np.linalg.norm(error) > OFF_CENTRE)

    def _act_in(self, phase: Phase, state: PrivilegedState) -> np.ndarray:
        return self._action(state, self._beginning(phase, state)).astype(float)

    def _beginning(self, phase: Phase, state: PrivilegedState) -> Progress:
        """The progress of a phase that has just begun, with the object taken from the ground where the hand is."""
        height = state.object_size[2] - self.config.finger_depth
        return Progress(phase, 0, np.array([*state.tcp[:2], height]))
