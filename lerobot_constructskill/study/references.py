"""Floors and ceilings: agents that show what a task asks of a policy, and what it does not."""

import numpy as np
import torch
from lerobot.datasets import LeRobotDataset

from lerobot_constructskill.contract import ACTION_SCALE, GRIPPER_CLOSED, GRIPPER_OPEN, Task
from lerobot_constructskill.demos.expert import ExpertConfig, PrivilegedState, make_expert
from lerobot_constructskill.study.agents import Observation, PolicyAgent
from lerobot_constructskill.study.prepare import GREY


class NoOp:
    """Stands still with the gripper open."""

    encoder = None

    def __init__(self, task: Task):
        self.still = np.zeros(len(task.action_names), dtype=np.float32)
        self.still[-1] = GRIPPER_OPEN

    def reset(self, seed: int) -> None:
        pass

    def act(self, observation: Observation) -> np.ndarray:
        return self.still


class Random(NoOp):
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


class Replay(NoOp):
    """Executes what one demonstration executed, whatever it sees, and then stands still."""

    def __init__(self, task: Task, demonstrations: LeRobotDataset, episode: int):
        super().__init__(task)
        row = demonstrations.meta.episodes[episode % demonstrations.num_episodes]
        rows = range(row["dataset_from_index"], row["dataset_to_index"])
        column = demonstrations.hf_dataset.with_format("numpy")["dart.executed_action"]
        self.actions = np.asarray(column[list(rows)], dtype=np.float32)

    def reset(self, seed: int) -> None:
        self.remaining = iter(self.actions)

    def act(self, observation: Observation) -> np.ndarray:
        return next(self.remaining, self.still)


class Expert(NoOp):
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


class Blind(PolicyAgent):
    """A policy that sees the same grey image always, and was trained on it."""

    def image(self, observation: Observation) -> torch.Tensor:
        return torch.full_like(super().image(observation), GREY)
