"""Noise on the executed action (Laskey et al. 2017, isotropic baseline); the stored label stays clean."""

from dataclasses import dataclass, field

import numpy as np

from lerobot_constructskill.demos.expert import Phase


@dataclass(frozen=True)
class NoiseConfig:
    """Zero-mean Gaussian noise on the executed translation (paper, section II).

    Args:
        sigma: standard deviation per axis, in metres; 0 turns noise off.
        clip: bound on each axis of the executed translation, in metres, with and without noise.
        phases: names of the phases that are perturbed. GRASP and RELEASE stay clean, so that contact is not.

    Raises:
        ValueError: sigma or clip out of range, or a phase that does not exist.
    """

    sigma: float = 0.01
    clip: float = 0.08
    phases: list[str] = field(default_factory=lambda: ["PREGRASP", "DESCEND", "LIFT", "CARRY"])

    def __post_init__(self):
        if not 0 <= self.sigma < np.inf:
            raise ValueError(f"Noise sigma must be 0 or more metres, not {self.sigma}.")
        if not self.clip > 0:
            raise ValueError(f"Noise clip must be above 0 metres, not {self.clip}.")
        unknown = [phase for phase in self.phases if phase not in list(Phase)]
        if unknown:
            raise ValueError(f"Unknown phase {unknown[0]!r}; the phases are: {', '.join(Phase)}.")


def execute(action: np.ndarray, phase: Phase, config: NoiseConfig, rng: np.random.Generator) -> np.ndarray:
    """The action that is executed where the expert asked for `action`.

    Args:
        action: (n,) clean action: a translation in metres first, the gripper last.
        rng: drawn from in every phase, so that a demonstration's noise does not depend on the phase mask.

    Returns:
        (n,) float32; the translation perturbed and clipped, every other channel unchanged.
    """
    noise = rng.normal(0.0, config.sigma, size=3) * (phase in config.phases)
    executed = action.copy()
    executed[:3] = np.clip(action[:3] + noise, -config.clip, config.clip)
    return executed
