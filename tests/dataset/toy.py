"""A stand-in for the simulator: a gripper that drifts where it is told, so that a data set takes seconds.

The experts, the noise, the recorder and the video encoder are the real ones.
"""

import numpy as np
import pandas as pd
import pytest

from lerobot_constructskill.contract import (
    IMAGE_SIZE,
    OBS_TYPES,
    PLURALS,
    REWARD_LIFTED,
    REWARD_PLACED,
    SIM_STATE,
    TASKS,
)
from lerobot_constructskill.demos import shards
from lerobot_constructskill.demos.recorder import GenerateConfig, record

RESPONSE = 0.3
"""Metres moved for a metre asked for, about what the simulated arm does."""

SIZE = np.array([0.21, 0.065, 0.10], dtype=np.float32)
BIN = np.array([0.0, -0.35, 0.08], dtype=np.float32)


class ToyEnv:
    """`ConstructSkillEnv` as far as a recorder uses it; seed 1000002 never succeeds."""

    light_robot, backend = True, "none"

    def __init__(self, task, obs_type, episode_length, light_robot=None, cameras=None, action="task"):
        self.cameras, self.episode_length = cameras or OBS_TYPES[obs_type], episode_length
        self.offset = 0.001 * [*TASKS].index(task)

    def reset(self, seed):
        self.seed, self.steps, self.settled, self.lifted = seed, 0, 0, False
        self.tcp = np.array([0.0, 0.0, 0.17])
        self.object = np.array([0.002 * (seed % 7) + self.offset, 0.0, 0.05])
        self.grip = 1.0
        coarse = np.random.default_rng(seed).integers(0, 255, (8, 8, 3), dtype=np.uint8)
        self.background = coarse.repeat(IMAGE_SIZE // 8, axis=0).repeat(IMAGE_SIZE // 8, axis=1)
        return self._observe(), {}

    def step(self, action):
        self.steps += 1
        self.tcp = self.tcp + RESPONSE * action[:3]
        held = self.grip < 0 and np.linalg.norm(self.tcp - self.object) < 0.06
        self.grip = float(action[-1])
        if held and self.grip < 0:
            self.object = self.tcp - [0, 0, 0.02]
        elif held:
            self.object = BIN.astype(float)
        self.lifted |= self.object[2] > 0.15
        self.settled = self.settled + 1 if (self.object == BIN).all() and self.grip > 0 else 0
        success = self.settled >= 5 and self.seed != 1_000_002
        reward = REWARD_PLACED if success else REWARD_LIFTED * self.lifted
        return self._observe(), float(reward), success, self.steps >= self.episode_length, {}

    def privileged_state(self):
        state = {
            "tcp_pose": [*self.tcp, 0, 1, 0, 0],
            "fingers": [0.04, 0.04] if self.grip > 0 else [0.0325, 0.0325],
            "object_pose": [*self.object, 1, 0, 0, 0],
            "object_size": SIZE,
            "object_mass": [1.365],
            "bin_position": BIN,
            "bin_interior": [0.25, 0.20, 0.15],
            "joint_positions": [0.1 * self.tcp[0], 0.4, 0, -2, 0, 2.4, 0.8, 0.04, 0.04],
            "joint_velocities": np.zeros(9),
        }
        one = {
            "placement": [0],
            "is_object": [1],
            "is_placed": [float(self.settled >= 5)],
            "finger_forces": [],
            "object_forces": [],
        }
        for singular in ("object_pose", "object_size", "object_mass", "bin_position", "bin_interior"):
            one[PLURALS[singular]] = state[singular]
        for name, value in one.items():
            state[name] = np.pad(value, (0, len(SIM_STATE[name]) - len(value)))
        return {name: np.array(value, dtype=np.float32) for name, value in state.items()}

    def agent_state(self):
        return np.array([*(self.tcp + [0.615, 0, 0]), np.pi, 0, 0, *self.privileged_state()["fingers"]], np.float32)

    def close(self):
        pass

    def _observe(self):
        image = self.background.copy()
        for place, colour in ((self.object, (200, 80, 40)), (self.tcp, (240, 240, 240))):
            u, v = (np.array([place[1] + 0.5, 0.7 - place[2]]) * 200).astype(int).clip(8, IMAGE_SIZE - 8)
            image[v - 8 : v + 8, u - 8 : u + 8] = colour
        return {"pixels": dict.fromkeys(self.cameras, image)}


def record_toy(root, episodes, **fields):
    """Record with the toy in place of this process's simulator."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(shards, "_environment", ToyEnv)
        record(GenerateConfig("local/toy", str(root), episodes=episodes, **fields))


def rows(change):
    """A corruption of data/: `change` takes the rows and returns them."""

    def corrupt(root):
        path = root / "data/chunk-000/file-000.parquet"
        change(pd.read_parquet(path)).to_parquet(path)

    return corrupt
