"""DART (Laskey et al. 2017): the noise covariance from a trained policy's error on held-out demonstrations.

One iteration: train on the demonstrations, fit here, generate with the covariance that came out. The expert's states
under that noise are then those that the policy's own errors lead to.
"""

from collections.abc import Callable

import numpy as np
import torch
from lerobot.datasets import LeRobotDataset
from lerobot.policies import PreTrainedPolicy

from lerobot_constructskill.errors import InputError
from lerobot_constructskill.progress import Progress


def policy_errors(
    policy: PreTrainedPolicy,
    preprocess: Callable,
    postprocess: Callable,
    dataset: LeRobotDataset,
    episode: int,
    phases: list[str],
) -> np.ndarray:
    """The policy's translation minus the expert's, on the expert's own states, while the phase is one of `phases`.

    Returns:
        (n, 3) in metres
    """
    policy.reset()
    row = dataset.meta.episodes[episode]
    errors = []
    for index in Progress(range(row["dataset_from_index"], row["dataset_to_index"]), f"episode {episode}"):
        frame = dataset[index]
        batch = {name: value[None] for name, value in frame.items() if name.startswith("observation.")}
        with torch.inference_mode():
            action = postprocess(policy.select_action(preprocess(batch | {"task": [frame["task"]]})))
        if frame["phase"] in phases:
            errors.append((action[0].float().cpu() - _clean_action(frame))[:3].numpy())
    return np.array(errors, dtype=np.float64).reshape(-1, 3)


def _clean_action(frame: dict) -> torch.Tensor:
    clean = frame["dart.executed_action"].clone()
    clean[:3] -= frame["dart.noise"]
    return clean


def fit_covariance(errors: list[np.ndarray], alpha: float | None = None) -> np.ndarray:
    """Mean over episodes of the mean of e e^T, which is large where the policy is biased too.

    Args:
        errors: one (n, 3) array per episode, in metres.
        alpha: scale the covariance so that the squared error of an episode of mean length sums to this, in m2.

    Returns:
        (3, 3) in m2

    Raises:
        ValueError: no episode has an error, or alpha is not above 0, or nothing to scale to it.
    """
    errors = [error for error in errors if len(error)]
    if not errors:
        raise InputError("The held-out episodes have no frame in a perturbed phase to fit noise on.")
    if alpha is not None and not alpha > 0:
        raise InputError(f"alpha must be above 0 m2, not {alpha}.")
    covariance = np.mean([error.T @ error / len(error) for error in errors], axis=0)
    if alpha is None:
        return covariance
    if not np.trace(covariance) > 0:
        raise InputError("The policy has no error on the held-out episodes, so there is nothing to scale to alpha.")
    length = np.mean([len(error) for error in errors])
    return covariance * alpha / (length * np.trace(covariance))
