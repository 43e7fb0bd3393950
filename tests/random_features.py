"""A feature set of random numbers, written through LeRobot: seeds train on it without simulator or encoder."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest
import torch
from lerobot.datasets import LeRobotDataset
from safetensors.torch import load_file, save_file

from lerobot_constructskill.policies.frozen_vit.backbones import BACKBONES
from lerobot_constructskill.policies.frozen_vit.configuration_frozen_vit import FrozenViTChunkConfig
from lerobot_constructskill.policies.frozen_vit.encoder import FrozenEncoder
from lerobot_constructskill.policies.frozen_vit.feature_sets import PATCHES_FILE, bind_patches, describe
from lerobot_constructskill.policies.frozen_vit.readouts import POINT_NAMES
from lerobot_constructskill.policies.frozen_vit.weights import state_sha256

TINY = "vit_tiny16"
EPISODES, LENGTH = 8, 12


@pytest.fixture(scope="session")
def tiny_weights(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Random weights of the real tiny architecture."""
    file = tmp_path_factory.mktemp("weights") / "tiny.safetensors"
    with torch.random.fork_rng():
        torch.manual_seed(0)
        save_file(FrozenEncoder(BACKBONES[TINY]).model.state_dict(), file)
    return file


@pytest.fixture(scope="session")
def feature_set(tmp_path_factory: pytest.TempPathFactory, tiny_weights: Path) -> LeRobotDataset:
    return write_random_set(tmp_path_factory.mktemp("features") / "set", tiny_weights, seed=0)


@pytest.fixture(scope="session")
def other_set(tmp_path_factory: pytest.TempPathFactory, tiny_weights: Path) -> LeRobotDataset:
    """Other random numbers by the same encoder."""
    return write_random_set(tmp_path_factory.mktemp("features") / "other", tiny_weights, seed=1)


@pytest.fixture(scope="session")
def told_set(tmp_path_factory: pytest.TempPathFactory, tiny_weights: Path) -> LeRobotDataset:
    """Two tasks, each with one action, opposite to each other: only the sentence says which."""
    tasks = "Put the brick into the grey bin.", "Put the brick into the blue bin."
    return write_random_set(tmp_path_factory.mktemp("features") / "told", tiny_weights, seed=2, tasks=tasks)


def write_random_set(root: Path, tiny_weights: Path, seed: int, tasks: Sequence[str] = ("a task",)) -> LeRobotDataset:
    """Eight episodes whose actions are a linear function of random features, with random points and patch features.

    Where there are two tasks, the action is that of the task.
    """
    spec = BACKBONES[TINY]
    encoder = FrozenEncoder(spec)
    encoder.model.load_state_dict(load_file(tiny_weights))
    info = describe(spec, state_sha256(encoder.model.state_dict()), "float32")
    dim = spec.feature_dim
    column = {"dtype": "float32", "shape": (dim,), "names": None, "info": info}
    features = {
        "observation.features.base": column,
        "observation.points.base": {"dtype": "float32", "shape": (len(POINT_NAMES),), "names": POINT_NAMES},
        "observation.state": {"dtype": "float32", "shape": (8,), "names": [f"s{i}" for i in range(8)]},
        "action": {"dtype": "float32", "shape": (4,), "names": ["dx", "dy", "dz", "gripper"]},
    }
    dataset = LeRobotDataset.create("local/random", fps=20, root=root, features=features)
    rng = np.random.default_rng(seed)
    mixing = rng.normal(size=(dim, 4)) / np.sqrt(dim)
    for episode in range(EPISODES):
        number = episode % len(tasks)
        for _ in range(LENGTH):
            feature = rng.normal(size=dim) / len(tasks) ** 3
            action = 0.03 * np.tanh(feature @ mixing) if len(tasks) == 1 else np.full(4, 0.03 * (-1) ** number)
            action[3] = np.sign(action[3])
            dataset.add_frame(
                {
                    "observation.features.base": feature.astype(np.float32),
                    "observation.points.base": rng.uniform(-1, 1, len(POINT_NAMES)).astype(np.float32),
                    "observation.state": rng.normal(size=8).astype(np.float32),
                    "action": action.astype(np.float32),
                    "task": tasks[number],
                }
            )
        dataset.save_episode()
    dataset.finalize()
    patches = rng.normal(size=(EPISODES * LENGTH, spec.n_patches, dim)).astype(np.float16)
    np.save(root / PATCHES_FILE, patches)
    bind_patches(root)
    return LeRobotDataset("local/random", root=root)


@pytest.fixture(scope="session")
def config(tiny_weights: Path):
    """Make a configuration on the tiny backbone; keywords are fields."""

    def make(**fields) -> FrozenViTChunkConfig:
        fields = {"backbone": TINY, "backbone_path": str(tiny_weights), "save_backbone": False} | fields
        return FrozenViTChunkConfig(device="cpu", **fields)

    return make
