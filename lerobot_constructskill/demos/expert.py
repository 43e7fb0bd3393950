"""Scripted experts: pure functions of the privileged state and of their own progress, without the environment."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from enum import StrEnum
from importlib import import_module
from typing import Annotated, Protocol

import numpy as np

from lerobot_constructskill.bounds import Range, Steps, check
from lerobot_constructskill.contract import ACTION_SCALE, Task, get_task
from lerobot_constructskill.demos.state import PrivilegedState


class Phase(StrEnum):
    """The six phases of a demonstration, in order (paper, section II)."""

    PREGRASP = "PREGRASP"
    DESCEND = "DESCEND"
    GRASP = "GRASP"
    LIFT = "LIFT"
    CARRY = "CARRY"
    RELEASE = "RELEASE"


@dataclass(frozen=True)
class ExpertProgress:
    """How far an expert has come.

    Args:
        phase: the phase of the next action.
        steps: actions already issued in that phase.
        anchor: position of the end effector when the phase began, (3,) metres.
        number: the placement that it works on.
    """

    phase: Phase
    steps: int
    anchor: np.ndarray
    number: int = 0


Gain = Annotated[float, Range(above=0, most=100)]
Step = Annotated[float, Range(above=0, most=ACTION_SCALE, unit="m")]
Height = Annotated[float, Range(-1, 1, unit="m")]


@dataclass(frozen=True)
class ExpertConfig:
    """Gains, thresholds and dwells of a scripted expert.

    Args:
        gain: proportional gain, metres asked for per metre of error.
        max_step: largest translation asked for per axis and step while the jaws are empty, in metres.
        load_max_step: the same in LIFT and CARRY. `pd_ee_delta_pose` is a spring from the current pose, whose
            orientation sags the longer an object is held, so a loaded arm should not be slow.
        compliance: translation asked for per newton of held weight, in m/N, which keeps that spring from sinking.
        threshold: distance to a phase's target at which the phase ends, in metres.
        align_tolerance: distance along the jaws within which DESCEND goes below the object's top, in metres.
        grasp_dwell: steps spent closing the gripper.
        release_dwell: most steps spent above the bin with the gripper open.
        pregrasp_clearance: height above the grasp at which PREGRASP ends, in metres.
        lift_height: how far LIFT rises, in metres (paper, section II), or as high as the arm reaches: 0.24 m in the
            far corner of `brick_to_bin_shifted`.
        release_clearance: gap between the object and the bin's rim at RELEASE, in metres.
        finger_depth: how far below the object's top the finger tips grasp, in metres.

    Raises:
        ValueError: a value out of its range.
    """

    gain: Gain = 1.0
    max_step: Step = 0.012
    load_max_step: Step = 0.035
    compliance: Annotated[float, Range(0, 1, unit="m/N")] = 0.001
    threshold: Step = 0.02
    align_tolerance: Step = 0.006
    grasp_dwell: Steps = 10
    release_dwell: Steps = 20
    pregrasp_clearance: Height = 0.15
    lift_height: Height = 0.40
    release_clearance: Height = 0.04
    finger_depth: Height = 0.03

    def __post_init__(self):
        check(self, "expert.")


@dataclass(frozen=True)
class Advice:
    """What an expert would do in a state, whatever led to the state.

    Args:
        action: (len(task.action_names),) float32, in metres with the gripper last.
        phase: the phase it belongs to.
        hopeless: whether no action helps: the object is out of reach, tipped over, or beside a wall where the jaws do
            not fit. The action is then to open, rise and wait.
    """

    action: np.ndarray
    phase: Phase
    hopeless: bool = False


class Expert(Protocol):
    """A scripted controller, made from an `ExpertConfig`."""

    def start(self, state: PrivilegedState) -> ExpertProgress:
        """The progress before the first action."""

    def act(self, state: PrivilegedState, progress: ExpertProgress) -> tuple[np.ndarray, Phase, ExpertProgress | None]:
        """One step of a demonstration.

        Returns:
            The action, (len(task.action_names),) float32 in metres with the gripper last, its phase, and the progress
            after it, or None once the demonstration is over.
        """

    def advise(self, state: PrivilegedState) -> Advice:
        """The action from the state alone, also in states that the expert never reaches by itself.

        When a learner acts, the expert has no progress of its own.
        """


class Widened:
    """An expert whose actions get channels that it does not use, which are 0.

    Args:
        expert: whose actions.
        own: the names of its channels.
        names: those of the actions that it is to give.
    """

    def __init__(self, expert: Expert, own: Sequence[str], names: Sequence[str]):
        self.expert, self.size, self.places = expert, len(names), [names.index(name) for name in own]

    def start(self, state: PrivilegedState) -> ExpertProgress:
        return self.expert.start(state)

    def act(self, state: PrivilegedState, progress: ExpertProgress) -> tuple[np.ndarray, Phase, ExpertProgress | None]:
        action, phase, after = self.expert.act(state, progress)
        return self._wide(action), phase, after

    def advise(self, state: PrivilegedState) -> Advice:
        advice = self.expert.advise(state)
        return replace(advice, action=self._wide(advice.action))

    def _wide(self, action: np.ndarray) -> np.ndarray:
        wide = np.zeros(self.size, dtype=np.float32)
        wide[self.places] = action
        return wide


def make_expert(task: Task, config: ExpertConfig) -> Expert:
    """The expert of `task`, as its row in the contract table names it; it acts in the row's channels."""
    module, name = task.expert.split(":")
    expert, own = getattr(import_module(module), name)(config), get_task(task.name).action_names
    return expert if task.action_names == own else Widened(expert, own, task.action_names)
