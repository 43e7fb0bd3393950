"""Planning: power, the smallest detectable difference, wrong orders and the number of seeds needed."""

from functools import cache
from math import ceil, inf, sqrt

import numpy as np
from scipy.stats import binom, hypergeom
from statsmodels.stats.power import TTestIndPower, normal_sample_size_one_tail
from statsmodels.stats.proportion import proportion_effectsize

TARGET = 0.8
"""Power that a study is planned for."""

MOST = 150
"""Largest number of seeds an arm that is searched for."""

RATIOS = (1.25, 1.5, 1.75, 2.0, 2.5, 3.0, 3.5, 4.0, 5.0, 6.0, 8.0, 10.0)
"""Of two standard deviations, that are tried in turn."""

SIMULATED, SHUFFLED = 500, 400
"""Studies that are simulated for each ratio, and orders of their seeds that are tried."""


def wrong_order(rate_a: float, rate_b: float, seeds: int) -> float:
    """Chance that the worse of two variants with these true rates succeeds in more seeds, of `seeds` seeds each."""
    joint = _joint(max(rate_a, rate_b), min(rate_a, rate_b), seeds)
    return float(np.triu(joint, 1).sum())


def power(rate_a: float, rate_b: float, seeds: int, alpha: float = 0.05) -> float:
    """Probability that Fisher's two-tailed test with `seeds` seeds an arm tells these rates apart, exactly.

    Fisher's test is used because its rejection region is fast to compute; Boschloo's has more power.
    """
    return float(_joint(rate_a, rate_b, seeds)[_rejected(seeds, alpha)].sum())


@cache
def seeds_needed(rate_a: float, rate_b: float, alpha: float = 0.05) -> float | None:
    """Seeds an arm with which Fisher's test tells these rates apart with 80 % power; None if they are equal.

    Infinite above `MOST`. The search begins at the normal approximation on arcsine-transformed rates (Cohen 1988,
    section 6.4), which is too low, by a half near 0 and 1.
    """
    if rate_a == rate_b:
        return None
    effect = proportion_effectsize(rate_a, rate_b)  # its estimate from n seeds an arm has the deviation sqrt(2 / n)
    seeds = max(2, ceil(normal_sample_size_one_tail(effect, TARGET, alpha / 2, std_null=sqrt(2))))
    while seeds <= MOST and power(rate_a, rate_b, seeds, alpha) < TARGET:
        seeds += 1
    return seeds if seeds <= MOST else inf


def detectable_mean_difference(deviation: float, seeds_a: int, seeds_b: int, alpha: float = 0.05) -> float:
    """The smallest difference of two means over seeds that is found with 80 % power.

    Computed for the t-test; the permutation test of means has about the same power. A result above 1 means that no
    difference of two shares is found.

    Args:
        deviation: standard deviation over the seeds of a side, above 0.
        seeds_a, seeds_b: two or more each.
    """
    effect = TTestIndPower().solve_power(nobs1=seeds_a, ratio=seeds_b / seeds_a, alpha=alpha, power=TARGET)
    return float(np.squeeze(effect)) * deviation


def seeds_needed_for_mean(difference: float, deviation: float, alpha: float = 0.05) -> float | None:
    """Seeds a side with which this difference of means is found with 80 % power; None for no difference.

    Infinite above `MOST`. The deviation is that over the seeds of a side, above 0.
    """
    if round(difference, 12) == 0:
        return None
    # `solve_power` for the number itself does not converge where the difference is large.
    enough = (n for n in range(2, MOST + 1) if detectable_mean_difference(deviation, n, n, alpha) <= difference)
    return next(enough, inf)


def detectable_spread_ratio(seeds_a: int, seeds_b: int, alpha: float = 0.05) -> float:
    """The smallest of `RATIOS` of two standard deviations over seeds that is found with 80 % power, else infinity.

    Simulated for seeds that vary normally about one mean, with the permutation test of `comparisons.spread_p_value`.
    Where one side has more seeds, the ratio is found whichever side varies more.

    Args:
        seeds_a, seeds_b: two or more each.
    """
    return max(_wider_first(seeds_a, seeds_b, alpha), _wider_first(seeds_b, seeds_a, alpha))


@cache
def _wider_first(seeds_a: int, seeds_b: int, alpha: float) -> float:
    """`detectable_spread_ratio` where the first seeds vary more."""
    rng = np.random.default_rng(0)
    seeds = rng.standard_normal((SIMULATED, seeds_a + seeds_b))
    orders = rng.permuted(np.tile(np.arange(seeds_a + seeds_b), (SHUFFLED, 1)), axis=1)
    for ratio in RATIOS:
        arms = seeds * np.repeat([ratio, 1.0], [seeds_a, seeds_b])
        seen = _apart(arms, seeds_a)
        as_far = sum(_apart(arms[:, order], seeds_a) >= seen - 1e-12 for order in orders)
        if np.mean((1 + as_far) / (1 + SHUFFLED) < alpha) >= TARGET:
            return ratio
    return inf


def _apart(rates: np.ndarray, seeds_a: int) -> np.ndarray:
    """Difference of the standard deviations of the first seeds and the others, (simulations,)."""
    return np.abs(rates[:, :seeds_a].std(axis=1) - rates[:, seeds_a:].std(axis=1))


def _joint(rate_a: float, rate_b: float, seeds: int) -> np.ndarray:
    """Probability of every pair of counts, (seeds + 1, seeds + 1)."""
    counts = np.arange(seeds + 1)
    return np.outer(binom.pmf(counts, seeds, rate_a), binom.pmf(counts, seeds, rate_b))


@cache
def _rejected(seeds: int, alpha: float) -> np.ndarray:
    """The pairs of counts that Fisher's test rejects, bool (seeds + 1, seeds + 1)."""
    rejected = np.zeros((seeds + 1, seeds + 1), dtype=bool)
    for met in range(2 * seeds + 1):  # successes of both arms together, which the test conditions on
        a = np.arange(max(0, met - seeds), min(met, seeds) + 1)
        chances = hypergeom.pmf(a, 2 * seeds, met, seeds)
        as_unlikely = chances <= chances[:, None] * (1 + 1e-9)
        rejected[a, met - a] = as_unlikely @ chances < alpha
    return rejected
