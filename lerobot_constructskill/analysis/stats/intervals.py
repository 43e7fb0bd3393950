"""Intervals over seeds, of a share, a difference of two and a mean: in [0, 1], two-sided, 95 % by default."""

from typing import NamedTuple

import numpy as np
from scipy.interpolate import BSpline
from scipy.optimize import brentq
from scipy.stats import binomtest
from statsmodels.stats.proportion import confint_proportions_2indep

from lerobot_constructskill.analysis.stats.outcomes import Counts
from lerobot_constructskill.errors import InputError


class Estimate(NamedTuple):
    """A value with the interval that holds it."""

    value: float
    low: float
    high: float


def clopper_pearson(counts: Counts, level: float = 0.95) -> Estimate:
    """The exact interval: covers at least `level` whatever the true rate (Clopper and Pearson 1934).

    Raises:
        InputError: there is no seed.
    """
    _require_seeds(counts)
    low, high = binomtest(counts.met, counts.seeds).proportion_ci(level, "exact")
    return Estimate(counts.rate, float(low), float(high))


def newcombe(a: Counts, b: Counts, level: float = 0.95) -> Estimate:
    """Difference of two rates, a's minus b's, in [-1, 1], from their Wilson intervals (Newcombe 1998, method 10).

    Raises:
        InputError: an arm has no seed.
    """
    for counts in (a, b):
        _require_seeds(counts)
    low, high = confint_proportions_2indep(
        a.met, a.seeds, b.met, b.seeds, method="newcomb", compare="diff", alpha=1 - level
    )
    return Estimate(a.rate - b.rate, float(low), float(high))


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


def _require_seeds(counts: Counts) -> None:
    if counts.seeds < 1:
        raise InputError("An interval needs at least one seed; this variant has none.")
