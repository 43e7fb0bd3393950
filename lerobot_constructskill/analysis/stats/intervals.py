"""Intervals for a share of seeds and for the difference of two. Shares in [0, 1], two-sided, 95 % by default."""

from typing import NamedTuple

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


def _require_seeds(counts: Counts) -> None:
    if counts.seeds < 1:
        raise InputError("An interval needs at least one seed; this variant has none.")
