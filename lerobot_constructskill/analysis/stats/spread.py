"""Mean and spread of success over seeds, with permutation tests of both.

The paper's closing question: do vision-language-action policies reduce the variance over seeds? Where a seed succeeds
in all its episodes or in none, the standard deviation is sqrt(p (1 - p)) of its rate p, so a variant that seldom or
nearly always succeeds varies little: spread has to be read beside the mean.
"""

from collections.abc import Callable

import numpy as np
from scipy.interpolate import BSpline
from scipy.optimize import brentq
from scipy.stats import permutation_test

from lerobot_constructskill.analysis.stats.intervals import Estimate

PERMUTATIONS = 9999
"""Number of random permutations if there are too many to try all; then p >= 0.0001."""


def mean_rate(rates: np.ndarray, level: float = 0.95) -> Estimate:
    """Mean over seeds of the share of episodes that succeeded, with an interval over seeds.

    The interval is Gaffke's (2005), for means of numbers between two bounds: quantiles of the mean under random
    weights of the seeds and one more, which is at 0 for the lower end and at 1 for the upper. Seeds that succeed
    always or never have Clopper and Pearson's interval, and no distribution is known of which it covers less than
    `level` (Learned-Miller and Thomas, arXiv:1905.06208, who conjecture that there is none). A bootstrap covers less
    where seeds nearly always succeed, and of ten equal seeds its interval has no width.

    Args:
        rates: share in [0, 1] of each seed, (seeds,).
        level: of the interval.
    """
    tail = (1 - level) / 2
    return Estimate(float(np.mean(rates)), _quantile([*rates, 0.0], tail), _quantile([*rates, 1.0], 1 - tail))


def _quantile(points: list[float], share: float) -> float:
    """Quantile of the mean of points under weights from the flat Dirichlet distribution.

    The density of that mean is the B-spline with the points as knots (Curry and Schoenberg 1966).
    """
    knots = np.sort(points)
    first, last = float(knots[0]), float(knots[-1])
    if first == last:
        return first
    below, whole = BSpline.basis_element(knots).antiderivative(), (last - first) / (len(knots) - 1)
    # Not to the last point itself, which lies beyond the spline where it is a point several times.
    return float(brentq(lambda mean: below(mean) / whole - share, first, np.nextafter(last, first), xtol=1e-9))


def mean_p_value(a: np.ndarray, b: np.ndarray) -> float:
    """Permutation test, two-tailed, of the difference of a's and b's mean over seeds.

    It suits settings in which a seed succeeds in some of its episodes, where "at least once" says little.

    Args:
        a, b: share in [0, 1] of each seed, (seeds,) each.
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
        return 1.0  # scipy refuses a single seed, which says nothing of other seeds
    rng = np.random.default_rng(0)  # a generator of its own: the same p-value at every call
    result = permutation_test(
        arms, difference, vectorized=True, alternative="greater", n_resamples=PERMUTATIONS, rng=rng
    )
    return float(result.pvalue)
