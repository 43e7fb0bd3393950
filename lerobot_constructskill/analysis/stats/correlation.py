"""Rank correlation of held-out error and success over training runs."""

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np

from lerobot_constructskill.analysis.stats.intervals import Estimate

RESAMPLES = 999

FEWEST = 5
"""Fewest runs for which an interval is computed."""

DRAWS_AT_ONCE = 100
"""Draws held in memory together."""

Groups = Sequence[np.ndarray]
"""Indices of the runs of each variant."""


class Correlation(NamedTuple):
    """Kendall's tau with its interval, and the p-value of no correlation."""

    tau: Estimate
    p_value: float


def kendall(
    error: np.ndarray, success: np.ndarray, variant: np.ndarray, rng: np.random.Generator
) -> Correlation | None:
    """Kendall's tau-b of held-out error and success over the pairs of runs of one variant.

    -1 means the lower the error the more success, as a useful offline error would show. Pairs of runs of different
    variants are left out, because differences between variants do not show that the error ranks the seeds of one.
    The p-value comes from permuting success within each variant, which keeps its level however few runs succeed. The
    95 % interval comes from resampling runs within each variant. It is too short where few succeed: decide by p.
    Closed forms ignore the many ties that success in all or no episodes makes, and `scipy.stats.kendalltau` includes
    pairs of different variants.

    Args:
        error: held-out error of each run, (runs,); runs without one (nan) are left out.
        success: share of its episodes that met the criterion, (runs,).
        variant: name of the variant of each run, (runs,).
        rng: source of the resamples.

    Returns:
        None if fewer than `FEWEST` runs are left, or in no variant both error and success differ.
    """
    error, success = np.asarray(error, dtype=float), np.asarray(success, dtype=float)
    kept = np.isfinite(error) & np.isfinite(success)
    error, success, variant = error[kept], success[kept], np.asarray(variant)[kept]
    groups = [np.flatnonzero(variant == name) for name in dict.fromkeys(variant)]
    tau = float(_tau_b(error, success, groups)) if len(error) else np.nan
    if len(error) < FEWEST or np.isnan(tau):
        return None
    resampled = _draws(lambda n: rng.integers(n, size=n), groups)
    resampled = np.concatenate([_tau_b(error[rows], success[rows], groups) for rows in resampled])
    low, high = np.nanquantile(resampled, [0.025, 0.975])
    permuted = np.concatenate([_tau_b(error, success[rows], groups) for rows in _draws(rng.permutation, groups)])
    as_large = np.sum(np.abs(permuted) >= abs(tau) - 1e-12)
    interval = Estimate(tau, min(float(low), tau), max(float(high), tau))
    return Correlation(interval, (1 + as_large) / (1 + RESAMPLES))


def _draws(draw: Callable[[int], np.ndarray], groups: Groups) -> list[np.ndarray]:
    """`RESAMPLES` draws of runs within each group, as arrays of (draws, runs)."""
    rows = np.empty((RESAMPLES, sum(map(len, groups))), dtype=int)
    for group in groups:
        rows[:, group] = [group[draw(len(group))] for _ in range(RESAMPLES)]
    return np.split(rows, range(DRAWS_AT_ONCE, RESAMPLES, DRAWS_AT_ONCE))


def _tau_b(x: np.ndarray, y: np.ndarray, groups: Groups) -> np.ndarray:
    """Tau-b over the pairs within groups, along the last axis; nan without a pair that differs in both."""
    sums = [_concordance(x[..., group], y[..., group]) for group in groups]
    concordance, untied_x, untied_y = (sum(parts) for parts in zip(*sums, strict=True))
    with np.errstate(invalid="ignore"):
        return concordance / np.sqrt(untied_x * untied_y)


def _concordance(x: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, ...]:
    """Concordant less discordant pairs, and pairs that are not tied in x and in y, each counted twice."""
    x, y = np.broadcast_arrays(x, y)
    signs = [np.sign(values[..., :, None] - values[..., None, :]) for values in (x, y)]
    return tuple((a * b).sum((-2, -1)) for a, b in ((signs[0], signs[1]), (signs[0],) * 2, (signs[1],) * 2))
