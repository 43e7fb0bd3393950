"""How much success varies from seed to seed, and whether two variants differ in that.

The paper's closing question: do vision-language-action policies reduce the variance over seeds? Where a seed succeeds
in all its episodes or in none, the standard deviation is sqrt(p (1 - p)) of its rate p, so a variant that seldom or
nearly always succeeds varies little: spread has to be read beside the mean.
"""

from collections.abc import Callable

import numpy as np
from scipy.stats import permutation_test

from lerobot_constructskill.analysis.stats.intervals import Estimate

DRAWS = 4000
PERMUTATIONS = 9999
"""Random ones, where there are more: p is then 0.0001 or more, which Holm multiplies by the number of comparisons."""


def mean_rate(rates: np.ndarray, rng: np.random.Generator, level: float = 0.95) -> Estimate:
    """Mean over seeds of the share of episodes that succeeded, with an interval over seeds.

    The interval is that of the Bayesian bootstrap (Rubin 1981) with one seed added at 0 and one at 1, widened to hold
    the mean. For all-or-nothing seeds that is Beta(met + 1, seeds - met + 1), the posterior of `probability_better`.
    Not `scipy.stats.bootstrap`, whose interval of ten equal seeds has no width; nor is there one of the deviation,
    whose bounds would be those of the two added seeds.

    Args:
        rates: share in [0, 1] of each seed, (seeds,).
        rng: source of the posterior draws.
        level: of the credible interval.
    """
    mean, values = float(np.mean(rates)), np.array([*rates, 0.0, 1.0])
    draws = rng.dirichlet(np.ones(len(values)), size=DRAWS) @ values
    low, high = np.quantile(draws, [(1 - level) / 2, (1 + level) / 2])
    return Estimate(mean, min(float(low), mean), max(float(high), mean))


def mean_p_value(a: np.ndarray, b: np.ndarray) -> float:
    """Permutation test, two-tailed, of the difference of a's and b's mean over seeds. Arguments of `spread_p_value`.

    For settings in which a seed succeeds in some of its episodes, where "at least once" says little.
    """
    return _permuted(np.mean, a, b)


def spread_p_value(a: np.ndarray, b: np.ndarray) -> float:
    """Permutation test, two-tailed, of the difference of a's and b's standard deviation over seeds.

    Seeds are exchanged between the arms, so that a small p speaks against equal distributions, in their spread; for
    all-or-nothing seeds it cannot be smaller than what the counts allow. Tests on centred values can: ten equal seeds
    have a deviation of exactly zero.

    Args:
        a, b: share in [0, 1] of each seed, (seeds,) each.
    """
    return _permuted(np.std, a, b)


def _permuted(statistic: Callable, a: np.ndarray, b: np.ndarray) -> float:
    def difference(x: np.ndarray, y: np.ndarray, axis: int) -> np.ndarray:
        # Rounded, or equal statistics would be told apart by their last bit.
        return np.abs(statistic(x, axis=axis) - statistic(y, axis=axis)).round(12)

    arms = np.asarray(a, dtype=float), np.asarray(b, dtype=float)
    if min(map(len, arms)) < 2:
        return 1.0  # scipy refuses a single seed, which tells nothing of the others
    rng = np.random.default_rng(0)  # of its own: the same p-value at every call, whatever else is tested
    result = permutation_test(
        arms, difference, vectorized=True, alternative="greater", n_resamples=PERMUTATIONS, rng=rng
    )
    return float(result.pvalue)
