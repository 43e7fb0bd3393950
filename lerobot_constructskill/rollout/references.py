"""References, the floors and ceilings beside which results are read. Each is an entry of `REFERENCES`.

A reference is an agent of its own, or a variant of the study with some fields of its policy set otherwise. Another
package adds one with `REFERENCES["name"] = Reference(...)` where LeRobot imports it as a plugin.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from lerobot.datasets import LeRobotDataset

from lerobot_constructskill.contract import ACTION_SCALE, GRIPPER_CLOSED, GRIPPER_OPEN, TASK_NAME, Task
from lerobot_constructskill.demos.expert import ExpertConfig, PrivilegedState, make_expert
from lerobot_constructskill.rollout.agents import Agent, Observation


class NoOpAgent:
    """Stands still with the gripper open."""

    cameras = ()

    def __init__(self, task: Task):
        self.still = np.zeros(len(task.action_names), dtype=np.float32)
        self.still[-1] = GRIPPER_OPEN

    def reset(self, seed: int) -> None:
        pass

    def act(self, observation: Observation) -> np.ndarray:
        return self.still


class RandomAgent(NoOpAgent):
    """Draws every action uniformly from the action space; `seed` and the episode's seed decide which."""

    def __init__(self, task: Task, seed: int):
        super().__init__(task)
        self.seed = seed

    def reset(self, seed: int) -> None:
        self.rng = np.random.default_rng((self.seed, seed))

    def act(self, observation: Observation) -> np.ndarray:
        action = self.rng.uniform(-ACTION_SCALE, ACTION_SCALE, self.still.shape).astype(np.float32)
        action[-1] = self.rng.choice([GRIPPER_CLOSED, GRIPPER_OPEN])
        return action


class ReplayAgent(NoOpAgent):
    """Executes the actions of one demonstration of the task, whatever it sees, and then stands still."""

    def __init__(self, task: Task, demonstrations: LeRobotDataset, episode: int):
        super().__init__(task)
        known = demonstrations.meta.episodes
        names = known[TASK_NAME] if TASK_NAME in known.column_names else []
        own = [number for number, name in enumerate(names) if name == task.name] or range(demonstrations.num_episodes)
        row = known[own[episode % len(own)]]
        rows = range(row["dataset_from_index"], row["dataset_to_index"])
        column = demonstrations.hf_dataset.with_format("numpy")["dart.executed_action"]
        self.actions = np.asarray(column[list(rows)], dtype=np.float32)

    def reset(self, seed: int) -> None:
        self.remaining = iter(self.actions)

    def act(self, observation: Observation) -> np.ndarray:
        return next(self.remaining, self.still)


class ExpertAgent(NoOpAgent):
    """The scripted expert without noise: it sees the simulator's state."""

    def __init__(self, task: Task):
        super().__init__(task)
        self.expert = make_expert(task, ExpertConfig())

    def reset(self, seed: int) -> None:
        self.progress = None
        self.is_over = False

    def act(self, observation: Observation) -> np.ndarray:
        if self.is_over:
            return self.still
        state = PrivilegedState(**observation.sim)
        action, _, self.progress = self.expert.act(state, self.progress or self.expert.start(state))
        self.is_over = self.progress is None
        return action


@dataclass(frozen=True)
class Reference:
    """A floor or a ceiling.

    Args:
        label: what tables call it.
        agent: makes the agent for a task, a seed and the setting's demonstrations (None unless it reads them).
        reads_demonstrations: whether the agent reads the setting's demonstrations.
        policy: in place of an agent, fields that are set otherwise in the first variant whose policy has them.
        is_expert: whether the scripted expert acts, so that its code is part of what the rows were made with.
        looks: whether it sees the scene. A setting in which one places that does not look asks for no looking.
    """

    label: str
    agent: Callable[[Task, int, LeRobotDataset | None], Agent] | None = None
    reads_demonstrations: bool = False
    policy: Mapping[str, Any] = field(default_factory=dict)
    is_expert: bool = False
    looks: bool = True


REFERENCES: dict[str, Reference] = {
    "no_op": Reference("No-op", lambda task, *_: NoOpAgent(task)),
    "random": Reference("Random actions", lambda task, seed, _: RandomAgent(task, seed)),
    "replay": Reference(
        "Open-loop replay of one demonstration",
        lambda task, seed, demonstrations: ReplayAgent(task, demonstrations, seed),
        reads_demonstrations=True,
        looks=False,
    ),
    "blind": Reference("Blind policy (constant image)", policy={"blind": True}, looks=False),
    "untrained": Reference("Same ViT, random weights", policy={"backbone_pretrained": False}),
    "expert": Reference("Scripted expert", lambda task, *_: ExpertAgent(task), is_expert=True),
}
