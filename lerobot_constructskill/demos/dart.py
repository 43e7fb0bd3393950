"""DART (Laskey et al. 2017): the noise covariance from a trained policy's error on held-out demonstrations.

One iteration: train on the demonstrations, fit here, generate with the covariance that came out. The expert's states
under that noise are then those that the policy's own errors lead to.
"""

import numpy as np

from lerobot_constructskill.errors import InputError


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
