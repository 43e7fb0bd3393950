"""Gaussian noise on the executed action (Laskey et al. 2017), with a fixed or a fitted covariance."""

from dataclasses import dataclass, field
from functools import cached_property
from typing import Annotated

import numpy as np

from lerobot_constructskill.bounds import Among, Range, check
from lerobot_constructskill.contract import ACTION_SCALE, GRIPPER_CLOSED
from lerobot_constructskill.demos.expert import Phase
from lerobot_constructskill.errors import InputError

MODELS = ("fixed", "isotropic", "dart")

Sigma = Annotated[float, Range(0, 1, unit="m")]
PhaseName = Annotated[str, Among(tuple(Phase))]


@dataclass(frozen=True)
class NoiseConfig:
    """Zero-mean Gaussian noise on the executed translation.

    Args:
        model: `fixed`: `sigma` on every axis (paper, section II); `dart`: the fitted `covariance`; `isotropic`: as
            strong as that covariance, but equal on every axis.
        sigma: standard deviation per axis of `fixed`, in metres; 0 turns it off.
        covariance: 3 x 3, in m2: a policy's error on held-out demonstrations, as `constructskill-fit-noise` writes it.
        fitted_on: what the covariance was fitted on, for the data set's provenance.
        clip: bound on each axis of the executed translation, in metres, with and without noise.
        phases: names of the phases that are perturbed. By default GRASP and RELEASE are not, to keep
            contacts clean.
        release_sigma: standard deviation per axis, in metres, of the noise in RELEASE for as long as the jaws are
            closed; the paper has none there. Where a task leaves little play, demonstrations without it never show
            how an object beside its place is brought back.

    Raises:
        ValueError: unknown model or phase, sigma or clip out of range, or a covariance that is missing or wrong.
    """

    model: Annotated[str, Among(MODELS)] = "fixed"
    sigma: Sigma = 0.01
    covariance: list[list[float]] | None = None
    fitted_on: dict[str, str] | None = None
    clip: Annotated[float, Range(above=0, most=ACTION_SCALE, unit="m")] = 0.08
    phases: list[PhaseName] = field(default_factory=lambda: ["PREGRASP", "DESCEND", "LIFT", "CARRY"])
    release_sigma: Sigma = 0.0

    def __post_init__(self):
        check(self, "noise.")
        if self.model != "fixed" and self.covariance is None:
            raise InputError(f"Noise model '{self.model}' needs a covariance; constructskill-fit-noise writes one.")
        if self.covariance is None:
            return
        matrix = np.array(self.covariance) if len({len(row) for row in self.covariance}) == 1 else np.empty(0)
        if matrix.shape != (3, 3) or not np.allclose(matrix, matrix.T, atol=1e-12):
            raise InputError(f"A noise covariance must be a symmetric 3 x 3 matrix in m2, not {self.covariance}.")
        if np.linalg.eigvalsh(matrix).min() < -1e-9 * np.trace(matrix):
            raise InputError(f"The noise covariance {self.covariance} has a negative variance.")

    @cached_property
    def root(self) -> np.ndarray:
        """Symmetric square root of the noise's covariance, (3, 3) in metres."""
        if self.model == "fixed":
            return self.sigma * np.eye(3)
        covariance = np.array(self.covariance)
        if self.model == "isotropic":
            return np.sqrt(np.trace(covariance) / 3) * np.eye(3)
        values, vectors = np.linalg.eigh(covariance)
        return vectors * np.sqrt(np.maximum(values, 0)) @ vectors.T


def execute(action: np.ndarray, phase: Phase, config: NoiseConfig, rng: np.random.Generator) -> np.ndarray:
    """The action that is executed where the expert asked for `action`.

    Args:
        action: (n,) clean action: a translation in metres first, the gripper last.
        rng: drawn from in every phase, so that a demonstration's noise does not depend on the phase mask.

    Returns:
        (n,) float32; the translation perturbed and clipped, every other channel unchanged.
    """
    drawn = rng.standard_normal(3)
    noise = config.root @ drawn * (phase in config.phases)
    if config.release_sigma and phase == Phase.RELEASE and action[-1] == GRIPPER_CLOSED:
        noise = config.release_sigma * drawn
    executed = action.copy()
    executed[:3] = np.clip(action[:3] + noise, -config.clip, config.clip)
    return executed
