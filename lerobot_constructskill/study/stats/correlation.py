"""Does the offline error of a seed tell its success?"""

import warnings

import numpy as np
from scipy.stats import bootstrap, kendalltau

from lerobot_constructskill.study.stats.intervals import Estimate

RESAMPLES = 999

FEWEST = 5
"""Runs below which no interval is worth its name."""


def kendall(error: np.ndarray, success: np.ndarray, rng: np.random.Generator, level: float = 0.95) -> Estimate | None:
    """Kendall's tau-b of held-out error and success over runs, with a percentile bootstrap interval over runs.

    -1: the lower the error the more success, which is what a useful offline error would show. The bootstrap, because
    closed forms leave out the many ties that success in all or no episodes makes.

    Args:
        error: held-out error of each run, (runs,); runs without one (nan) are left out.
        success: episodes that met the criterion, (runs,).
        rng: source of the resamples.
        level: of the interval.

    Returns:
        None where fewer than `FEWEST` runs are left, or all have the same error or the same success.
    """
    error, success = np.asarray(error, dtype=float), np.asarray(success, dtype=float)
    kept = np.isfinite(error) & np.isfinite(success)
    error, success = error[kept], success[kept]
    if len(error) < FEWEST or np.ptp(error) == 0 or np.ptp(success) == 0:
        return None
    value = float(kendalltau(error, success).statistic)
    draws = _resampled(error, success, rng)
    low, high = np.quantile(draws, [(1 - level) / 2, (1 + level) / 2])
    return Estimate(value, min(float(low), value), max(float(high), value))


def _resampled(error: np.ndarray, success: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Tau of resampled runs; resamples in which all runs succeed alike have none and are left out."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        draws = bootstrap(
            (error, success),
            _tau_b,
            paired=True,
            vectorized=True,
            n_resamples=RESAMPLES,
            batch=100,
            method="percentile",
            rng=rng,
        ).bootstrap_distribution
    return draws[np.isfinite(draws)]


def _tau_b(x: np.ndarray, y: np.ndarray, axis: int) -> np.ndarray:
    """What `kendalltau` computes, over the last axis of stacked samples: it takes one sample, in 0.3 ms."""
    signs = [np.sign(values[..., :, None] - values[..., None, :]) for values in (x, y)]
    concordance, *untied = ((a * b).sum((-2, -1)) for a, b in ((signs[0], signs[1]), (signs[0],) * 2, (signs[1],) * 2))
    return concordance / np.sqrt(untied[0] * untied[1])
