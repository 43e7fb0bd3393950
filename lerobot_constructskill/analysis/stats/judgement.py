"""Compares two sides, each of some training seeds that were evaluated on the same starts."""

from dataclasses import dataclass
from math import comb, sqrt

import numpy as np

from lerobot_constructskill.analysis.stats.comparisons import (
    PERMUTATIONS,
    Conclusion,
    boschloo,
    conclude,
    mean_difference,
    mean_p_value,
    spread_p_value,
)
from lerobot_constructskill.analysis.stats.intervals import Estimate, mean_rate
from lerobot_constructskill.analysis.stats.outcomes import Counts, count
from lerobot_constructskill.analysis.stats.power import (
    detectable_mean_difference,
    detectable_spread_ratio,
    seeds_needed_for_mean,
)


@dataclass(frozen=True)
class Judgement:
    """What the seeds show of side a against side b.

    Args:
        counts_a, counts_b: seeds that succeeded in at least one episode.
        mean_a, mean_b: mean over seeds of the share of successful episodes, in [0, 1], with its interval.
        difference: a's mean minus b's, with its interval.
        p_value: p-value of the difference of means, from a permutation of seeds; it decides the conclusion.
        smallest_p_value: smallest p-value that so many seeds can give.
        counts_p_value: p-value of the counts, from Boschloo's exact test.
        spread_a, spread_b: standard deviation of the share over seeds (divisor n), in [0, 0.5].
        spread_p_value: p-value of the difference of these, from a permutation of seeds.
        conclusion: from `p_value` and `difference`.
        visible: smallest difference of means that 80 % of comparisons with so many seeds find, if seeds vary as these
            do; None if they do not vary, or a side has one seed.
        visible_spread: smallest ratio of the spreads that 80 % of comparisons with so many seeds find, if seeds vary
            normally; infinite if they find none, None if a side has one seed.
        seeds_needed: seeds a side that find the observed difference with 80 % power; None if there is no difference
            or `visible` is None, infinite above `power.MOST`.
    """

    counts_a: Counts
    counts_b: Counts
    mean_a: Estimate
    mean_b: Estimate
    difference: Estimate
    p_value: float
    smallest_p_value: float
    counts_p_value: float
    spread_a: float
    spread_b: float
    spread_p_value: float
    conclusion: Conclusion
    visible: float | None
    visible_spread: float | None
    seeds_needed: float | None


def judge(a: np.ndarray, b: np.ndarray, alpha: float = 0.05) -> Judgement:
    """Compare two sides.

    Args:
        a, b: share in [0, 1] of successful episodes of each seed, (seeds,) each, one or more.
        alpha: level of the test; intervals are at 1 - alpha.
    """
    counts_a, counts_b = count(a), count(b)
    mean_a, mean_b = (mean_rate(rates, 1 - alpha) for rates in (a, b))
    apart, p_value, deviation = mean_difference(mean_a, mean_b), mean_p_value(a, b), _deviation(a, b)
    return Judgement(
        counts_a=counts_a,
        counts_b=counts_b,
        mean_a=mean_a,
        mean_b=mean_b,
        difference=apart,
        p_value=p_value,
        smallest_p_value=smallest_p_value(len(a), len(b)),
        counts_p_value=boschloo(counts_a, counts_b),
        spread_a=float(np.std(a)),
        spread_b=float(np.std(b)),
        spread_p_value=spread_p_value(a, b),
        conclusion=conclude(p_value, apart, alpha),
        visible=detectable_mean_difference(deviation, len(a), len(b), alpha) if deviation else None,
        visible_spread=detectable_spread_ratio(len(a), len(b), alpha) if min(len(a), len(b)) > 1 else None,
        seeds_needed=seeds_needed_for_mean(abs(apart.value), deviation, alpha) if deviation else None,
    )


def smallest_p_value(seeds_a: int, seeds_b: int) -> float:
    """The p-value of a permutation of seeds if every seed of one side did better than all of the other."""
    if min(seeds_a, seeds_b) < 2:
        return 1.0
    exact = (1 + (seeds_a == seeds_b)) / comb(seeds_a + seeds_b, seeds_a)
    return max(exact, 1 / (PERMUTATIONS + 1))  # of random permutations, if there are too many to try all


def _deviation(a: np.ndarray, b: np.ndarray) -> float:
    """Pooled standard deviation of the seeds of both sides; 0 if a side has a single seed."""
    if min(len(a), len(b)) < 2:
        return 0.0
    squares = sum(float(np.sum((rates - np.mean(rates)) ** 2)) for rates in (a, b))
    return sqrt(squares / (len(a) + len(b) - 2)) if squares > 1e-12 else 0.0
