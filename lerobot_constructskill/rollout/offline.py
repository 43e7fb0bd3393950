"""Errors of a policy's predictions on demonstrations, and the consistency of its chunks.

Every policy is asked the same of every frame, as it was asked in training: a fresh chunk from that frame's
observation. Action queues and temporal ensembling, which mix chunks of several frames, play no part. Policies that
sample (diffusion, flow) draw anew for every frame, which their consistency includes.
"""

from collections.abc import Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from lerobot.datasets import LeRobotDataset, resolve_delta_timestamps
from lerobot.policies import PreTrainedPolicy
from lerobot.utils import ACTION
from torch.utils.data import DataLoader, Subset

from lerobot_constructskill.contract import GRIPPER, TRANSLATION
from lerobot_constructskill.errors import InputError
from lerobot_constructskill.lerobot_internals import lerobot_collate_fn
from lerobot_constructskill.progress import Progress
from lerobot_constructskill.rollout.agents import PolicyAgent, observing

FRAMES, BATCH = 512, 32
"""Number of frames with pictures on which the held-out error is measured, at most, and how many are read at a time."""


@dataclass(frozen=True)
class Predictions:
    """What a policy predicts from T frames, of one demonstration for `offline_metrics`.

    Args:
        labels: (T, A) what the demonstration did, in metres (radians), translations first, the gripper last.
        chunks: (T, C, A) what the policy would do from each frame on; C is 1 for a policy without chunks.
    """

    labels: np.ndarray
    chunks: np.ndarray


@dataclass(frozen=True)
class OfflineMetrics:
    """Means over the frames of all demonstrations, of the first action of every chunk unless said otherwise.

    Args:
        frames: how many frames.
        rmse_m: root of the mean squared length of the translation error, in metres.
        mean_m: mean length of the translation error, in metres.
        rmse_dx_m, rmse_dy_m, rmse_dz_m: root mean squared error along each axis, in metres.
        rmse_rotation_rad: root of the mean squared length of the rotation error, in radians; None for tasks that do
            not turn.
        gripper_accuracy: share of frames on which the gripper's sign is the demonstration's.
        gripper_change_accuracy: the same of the two frames around each opening and closing, so that a gripper that
            never moves gets one half; None where the demonstrations never open nor close.
        consistency_m: mean distance between what the chunks of two consecutive frames say about the same step's
            translation, in metres; None for policies without chunks.
    """

    frames: int
    rmse_m: float
    mean_m: float
    rmse_dx_m: float
    rmse_dy_m: float
    rmse_dz_m: float
    rmse_rotation_rad: float | None
    gripper_accuracy: float
    gripper_change_accuracy: float | None
    consistency_m: float | None


def offline_metrics(episodes: Sequence[Predictions]) -> OfflineMetrics:
    """Compare what was predicted with what was done."""
    axes = len(TRANSLATION)
    errors = np.concatenate([one.chunks[:, 0] - one.labels for one in episodes]).astype(np.float64)
    lengths = np.linalg.norm(errors[:, :axes], axis=1)
    rotations = np.linalg.norm(errors[:, axes:-1], axis=1)
    right = [np.sign(one.chunks[:, 0, -1]) == np.sign(one.labels[:, -1]) for one in episodes]
    around = [_around_changes(one.labels[:, -1]) for one in episodes]
    at_changes = np.concatenate([hits[frames] for hits, frames in zip(right, around, strict=True)])
    disagreements = np.concatenate([_disagreements(one.chunks[..., :axes]) for one in episodes])
    return OfflineMetrics(
        len(errors),
        _root_mean_square(lengths),
        float(lengths.mean()),
        *(_root_mean_square(error) for error in errors[:, :axes].T),
        rmse_rotation_rad=_root_mean_square(rotations) if errors.shape[1] > axes + 1 else None,
        gripper_accuracy=float(np.concatenate(right).mean()),
        gripper_change_accuracy=float(at_changes.mean()) if len(at_changes) else None,
        consistency_m=float(disagreements.mean()) if len(disagreements) else None,
    )


def _root_mean_square(values: np.ndarray) -> float:
    return float(np.sqrt(np.mean(values**2)))


def _around_changes(gripper: np.ndarray) -> np.ndarray:
    """Frames before and after each change of sign in (T,) labels."""
    before = np.flatnonzero(np.diff(np.sign(gripper)))
    return np.sort(np.concatenate([before, before + 1]))


def _disagreements(chunks: np.ndarray) -> np.ndarray:
    """Distances between (T, C, 3) chunks of consecutive frames, step by step, up to the demonstration's end."""
    length, size, _ = chunks.shape
    earlier, later = chunks[:-1, 1:], chunks[1:, : size - 1]
    distances = np.linalg.norm(earlier.astype(np.float64) - later, axis=-1)
    steps = np.arange(1, length)[:, None] + np.arange(size - 1)
    return distances[steps < length]


def check_actions(policy: PreTrainedPolicy, dataset: LeRobotDataset) -> None:
    """Refuse a policy whose actions are not those of the demonstrations, or demonstrations in other units than ours.

    Raises:
        InputError: their names or their number differ; most policies know no names.
    """
    names = dataset.meta.features[ACTION]["names"]
    if not isinstance(names, list) or tuple(names[:3]) != TRANSLATION or names[-1] != GRIPPER:
        wanted = ", ".join((*TRANSLATION, "any rotations", GRIPPER))
        raise InputError(f"'{dataset.repo_id}' must have the actions {wanted}, not {names}.")
    acts_in = getattr(policy.config, "action_names", None)
    if acts_in not in (None, names):
        raise InputError(f"The policy acts in {acts_in}, but the actions of '{dataset.repo_id}' are {names}.")
    feature = policy.config.output_features.get(ACTION)
    if feature and feature.shape[0] != len(names):
        raise InputError(
            f"The policy's actions have {feature.shape[0]} numbers, those of '{dataset.repo_id}' have {len(names)}."
        )


def observing_frames(dataset: LeRobotDataset) -> AbstractContextManager[None]:
    """Context in which a policy that reads an observation which a data set lacks is an InputError, not a KeyError."""
    has = ", ".join(name for name in dataset.meta.features if name.startswith("observation."))
    return observing(dataset.meta.features, f"'{dataset.repo_id}' has {has}")


def predict(agent: PolicyAgent, dataset: LeRobotDataset, frames: Sequence[int], batch_size: int) -> Predictions:
    """Ask a policy for a chunk from each of some frames.

    Args:
        agent: any LeRobot policy between its processors.
        dataset: the data set, as `open_for` opens it for this policy.
        frames: indices of the frames.
        batch_size: frames at a time.
    """
    agent.policy.reset()
    loader = DataLoader(Subset(dataset, frames), batch_size, collate_fn=lerobot_collate_fn)
    asked = [_ask(agent, batch) for batch in loader]
    return Predictions(*(torch.cat(parts).float().cpu().numpy() for parts in zip(*asked, strict=True)))


@torch.inference_mode()
def _ask(agent: PolicyAgent, batch: dict) -> tuple[torch.Tensor, torch.Tensor]:
    """Labels (B, A) of a batch, and the chunks (B, C, A) that a policy predicts; C is 1 for a policy without chunks.

    Raises:
        InputError: the policy makes its chunks from a queue of past observations.
    """
    policy = agent.policy
    seen = {name: value for name, value in batch.items() if name.startswith("observation.")}
    seen = agent.preprocessor(seen | {name: batch[name] for name in ("task", "index")})
    try:
        chunk = policy.predict_action_chunk(seen)
    except NotImplementedError:
        policy.reset()  # its queue would answer for the batch before
        chunk = policy.select_action(seen)[:, None]
    except RuntimeError as error:
        if "non-empty TensorList" not in str(error):
            raise
        raise InputError(
            f"{policy.name} makes its chunks from a queue of past observations, which single frames do not fill: it "
            "can only be rolled out."
        ) from None
    return batch[ACTION], agent.postprocessor(chunk)


def spans(dataset: LeRobotDataset, episodes: Sequence[int]) -> list[range]:
    """Return the indices of the frames of each of some episodes."""
    rows = [dataset.meta.episodes[episode] for episode in episodes]
    return [range(row["dataset_from_index"], row["dataset_to_index"]) for row in rows]


def open_for(dataset: LeRobotDataset, policy: PreTrainedPolicy) -> LeRobotDataset:
    """Open the data set again with as many observations in a frame as the policy was trained on.

    A policy class that reads features in place of images has a method `read_features`, which is called here.

    Raises:
        InputError: another encoder than the policy's made the data set's features.
        MissingError: the data set lacks features that it needs.
    """
    if hasattr(policy, "read_features"):
        policy.read_features(dataset.meta)
    times = resolve_delta_timestamps(policy.config, dataset.meta) or {}
    times = {name: offsets for name, offsets in times.items() if name.startswith("observation.")}
    if not times:
        return dataset
    return LeRobotDataset(dataset.repo_id, root=dataset.root, revision=dataset.revision, delta_timestamps=times)


def policy_errors(
    agent: PolicyAgent, dataset: LeRobotDataset, episode: int, phases: list[str], labels: str
) -> np.ndarray:
    """The policy's translation minus the expert's, on the expert's own states, while the phase is one of `phases`.

    A policy that samples its actions draws them from the episode's number and the step. The expert is the one that
    the policy learns from: that of the `labels`, or where they are what was executed, the one that acted.

    Returns:
        (n, 3) in metres
    """
    agent.reset(episode)
    errors = []
    for index in Progress(*spans(dataset, [episode]), f"episode {episode}"):
        frame = dataset[index]
        batch = {name: value[None] for name, value in frame.items() if name.startswith("observation.")}
        action = agent.decide(agent.preprocessor(batch | {"task": [frame["task"]]}))
        if frame["phase"] in phases:
            clean = frame["dart.executed_action"][:3] - frame["dart.noise"]
            wanted = frame["action"][:3] if labels == "advice" else clean
            errors.append(action[:3] - wanted.numpy())
    return np.array(errors, dtype=np.float64).reshape(-1, 3)


def heldout_mse(checkpoint: Path, dataset: LeRobotDataset, episodes: Sequence[int], **acting: Any) -> float | None:
    """Mean squared translation error of a checkpoint on some demonstrations, in m2 (of one axis); None without any.

    The mean is over all steps of the chunks that the policy predicts from single frames, up to a demonstration's end.
    A policy without chunks is judged by its first actions. If the frames have pictures, at most `FRAMES` frames are
    used, evenly spaced. Policies that sample draw from a fixed seed.

    Args:
        dataset: demonstrations, or the features of demonstrations that the policy was trained on.
        episodes: numbers of the held-out episodes.
        acting: fields of the policy's configuration in place of its own, as of `PolicyAgent.from_pretrained`.

    Raises:
        InputError: the policy acts in other actions, reads what the demonstrations lack, or makes its chunks from a
            queue of past observations.
    """
    ends = {frame: span.stop for span in spans(dataset, episodes) for frame in span}
    if not ends:
        return None
    frames = [*ends]
    if dataset.meta.camera_keys and len(frames) > FRAMES:
        frames = [frames[number] for number in np.linspace(0, len(frames) - 1, FRAMES).astype(int)]
    agent = PolicyAgent.from_pretrained(checkpoint, **acting)
    check_actions(agent.policy, dataset)
    on_gpu = [agent.policy.config.device] if agent.policy.config.device.startswith("cuda") else []
    with observing_frames(dataset), torch.random.fork_rng(on_gpu):
        torch.manual_seed(0)
        chunks = predict(agent, open_for(dataset, agent.policy), frames, BATCH).chunks
    actions = np.asarray(dataset.hf_dataset.with_format("numpy")[ACTION][:], dtype=np.float64)
    return _mean_square(chunks, actions, frames, [ends[frame] for frame in frames])


def _mean_square(chunks: np.ndarray, actions: np.ndarray, frames: Sequence[int], ends: Sequence[int]) -> float:
    """Mean square of the translation errors of (n, C, A) chunks, each from its frame on, before its end."""
    axes = len(TRANSLATION)
    steps = np.asarray(frames)[:, None] + np.arange(chunks.shape[1])
    valid = steps < np.asarray(ends)[:, None]
    errors = chunks[valid][:, :axes] - actions[steps[valid]][:, :axes]
    return float(np.mean(errors**2))
