"""The held-out error of any LeRobot policy, as frozen_vit's trainer tells that of its own policies."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from lerobot.datasets import LeRobotDataset
from lerobot.utils import ACTION
from torch.utils.data import DataLoader, Subset

from lerobot_constructskill.contract import TRANSLATION
from lerobot_constructskill.rollout.agents import PolicyAgent
from lerobot_constructskill.rollout.offline import ask, check_actions, observed, observing_frames

FRAMES, BATCH = 512, 32
"""How many frames are looked at, at most, and how many at a time."""


def heldout_mse(checkpoint: Path, dataset: LeRobotDataset, episodes: Sequence[int], **acting: Any) -> float | None:
    """Mean squared translation error of a checkpoint on some demonstrations, in m2 (of one axis); None without any.

    It is over all steps of the chunks that the policy predicts from single frames, up to a demonstration's end, or
    over its first actions where it predicts no chunks. Of many frames with pictures, `FRAMES` are looked at, evenly
    spaced. What a policy samples is drawn from a fixed seed.

    Args:
        dataset: demonstrations, or the features of demonstrations that the policy was trained on.
        episodes: numbers of the held-out episodes.
        acting: fields of the policy's configuration in place of its own, as of `PolicyAgent.from_pretrained`.

    Raises:
        InputError: the policy acts in other actions, reads what the demonstrations lack, or makes its chunks from a
            queue of past observations.
    """
    ends = _ends(dataset, episodes)
    if not ends:
        return None
    frames = [*ends]
    if dataset.meta.camera_keys and len(frames) > FRAMES:
        frames = [frames[number] for number in np.linspace(0, len(frames) - 1, FRAMES).astype(int)]
    agent = PolicyAgent.from_pretrained(checkpoint, **acting)
    check_actions(agent.policy, dataset)
    view = Subset(observed(dataset, agent.policy), frames)
    on_gpu = [agent.policy.config.device] if agent.policy.config.device.startswith("cuda") else []
    with observing_frames(dataset), torch.random.fork_rng(on_gpu):
        torch.manual_seed(0)
        pipeline = agent.policy, agent.preprocessor, agent.postprocessor
        chunks = np.concatenate([ask(*pipeline, batch)[1].float().cpu().numpy() for batch in DataLoader(view, BATCH)])
    return _mean_square(chunks, _actions(dataset), frames, [ends[frame] for frame in frames])


def _ends(dataset: LeRobotDataset, episodes: Sequence[int]) -> dict[int, int]:
    """The frames of some demonstrations, each with the first frame behind its demonstration."""
    rows = [dataset.meta.episodes[episode] for episode in episodes]
    spans = [range(row["dataset_from_index"], row["dataset_to_index"]) for row in rows]
    return {frame: span.stop for span in spans for frame in span}


def _actions(dataset: LeRobotDataset) -> np.ndarray:
    """(frames, A) in metres, the gripper last."""
    return np.asarray(dataset.hf_dataset.with_format("numpy")[ACTION][:], dtype=np.float64)


def _mean_square(chunks: np.ndarray, actions: np.ndarray, frames: Sequence[int], ends: Sequence[int]) -> float:
    """Compare (n, C, A) chunks with the demonstrated actions from each frame on, before its end."""
    axes = len(TRANSLATION)
    steps = np.asarray(frames)[:, None] + np.arange(chunks.shape[1])
    valid = steps < np.asarray(ends)[:, None]
    errors = chunks[valid][:, :axes] - actions[steps[valid]][:, :axes]
    return float(np.mean(errors**2))
