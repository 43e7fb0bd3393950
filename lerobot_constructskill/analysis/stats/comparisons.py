"""Comparisons of two variants on one criterion: exact tests of seed counts, permutation tests of shares."""

from collections.abc import Mapping, Sequence
from enum import StrEnum
from typing import NamedTuple

import numpy as np
from scipy.integrate import quad
from scipy.stats import beta, boschloo_exact, fisher_exact
from statsmodels.stats.multitest import multipletests

from lerobot_constructskill.analysis.stats.intervals import Estimate, newcombe
from lerobot_constructskill.analysis.stats.outcomes import Counts
from lerobot_constructskill.analysis.stats.spread import mean_p_value, spread_p_value

ALIKE_WITHIN = 0.2
"""Two rates are alike if the interval of their difference lies within this distance of zero."""


class Conclusion(StrEnum):
    """What the seeds show of a against b."""

    BETTER = "better"
    WORSE = "worse"
    ALIKE = "alike"
    INCONCLUSIVE = "inconclusive at this number of seeds"


class CountComparison(NamedTuple):
    """Two variants by the number of seeds that met a criterion at least once.

    Args:
        a, b: the variants.
        counts_a, counts_b: their seed counts.
        difference: rate of a minus rate of b, with Newcombe's interval at 1 - alpha.
        fisher, boschloo: two-tailed p-values.
        holm: Boschloo's p-value, corrected over the declared comparisons.
        probability_better: probability that a's rate is higher.
        conclusion: from `holm` and `difference`.
    """

    a: str
    b: str
    counts_a: Counts
    counts_b: Counts
    difference: Estimate
    fisher: float
    boschloo: float
    holm: float
    probability_better: float
    conclusion: Conclusion


class RateComparison(NamedTuple):
    """Two variants by the share of episodes that met a criterion, over seeds.

    Args:
        a, b: the variants.
        mean: mean of a minus mean of b.
        mean_holm: its p-value from a permutation of seeds, corrected over the declared comparisons.
        spread: standard deviation of a minus that of b.
        spread_holm: its p-value, likewise.
    """

    a: str
    b: str
    mean: float
    mean_holm: float
    spread: float
    spread_holm: float


def fisher(a: Counts, b: Counts) -> float:
    """Fisher's exact test, two-tailed: the paper's (section III)."""
    return float(fisher_exact(_table(a, b)).pvalue)


def boschloo(a: Counts, b: Counts) -> float:
    """Boschloo's exact test, two-tailed (Boschloo 1970): for equal arms never less powerful than Fisher's; valid."""
    p_value = float(boschloo_exact(_table(a, b)).pvalue)
    return 1.0 if np.isnan(p_value) else min(p_value, 1.0)  # scipy has no p-value where all or no seeds met it


def holm(p_values: Sequence[float], family: int | None = None) -> list[float]:
    """Holm's step-down correction (Holm 1979).

    Args:
        p_values: p-values of the comparisons that could be made.
        family: number of declared comparisons; those that could not be made count as p = 1.
    """
    missing = (family or len(p_values)) - len(p_values)
    if not p_values:
        return []
    corrected = multipletests([*p_values, *[1.0] * missing], method="holm")[1]
    return [float(p_value) for p_value in corrected[: len(p_values)]]


def probability_better(a: Counts, b: Counts) -> float:
    """Probability that a's rate exceeds b's, each with a uniform prior: Beta(met + 1, seeds - met + 1)."""
    rate_a, rate_b = (beta(counts.met + 1, counts.seeds - counts.met + 1) for counts in (a, b))
    peak = rate_a.mean()  # told to quad, which may step over a narrow posterior
    return float(np.clip(quad(lambda rate: rate_a.pdf(rate) * rate_b.cdf(rate), 0, 1, points=[peak])[0], 0, 1))


def conclude(p_value: float, difference: Estimate, alpha: float = 0.05) -> Conclusion:
    """Conclude from a corrected p-value and the interval of the difference."""
    if p_value < alpha:
        return Conclusion.BETTER if difference.value > 0 else Conclusion.WORSE
    if max(-difference.low, difference.high) <= ALIKE_WITHIN:
        return Conclusion.ALIKE
    return Conclusion.INCONCLUSIVE


def compare_counts(
    counts: Mapping[str, Counts], pairs: Sequence[tuple[str, str]], alpha: float = 0.05
) -> list[CountComparison]:
    """Make those declared comparisons whose two variants have results.

    Args:
        counts: variant to seed counts on one criterion; variants without a result are absent.
        pairs: all declared comparisons, over which Holm's correction is taken.
        alpha: level of all of them together.
    """
    made = [(a, b, counts[a], counts[b]) for a, b in pairs if a in counts and b in counts]
    p_values = [boschloo(of_a, of_b) for _, _, of_a, of_b in made]
    compared = []
    for (a, b, of_a, of_b), p_value, corrected in zip(made, p_values, holm(p_values, len(pairs)), strict=True):
        difference = newcombe(of_a, of_b, level=1 - alpha)
        conclusion = conclude(corrected, difference, alpha)
        better = probability_better(of_a, of_b)
        p_values_of_pair = (fisher(of_a, of_b), p_value, corrected)
        compared.append(CountComparison(a, b, of_a, of_b, difference, *p_values_of_pair, better, conclusion))
    return compared


def compare_rates(rates: Mapping[str, np.ndarray], pairs: Sequence[tuple[str, str]]) -> list[RateComparison]:
    """Make the same comparisons of shares of episodes.

    Args:
        rates: variant to the share in [0, 1] of each seed, (seeds,).
        pairs: all declared comparisons.
    """
    made = [(a, b, rates[a], rates[b]) for a, b in pairs if a in rates and b in rates]
    means, spreads = (
        holm([test(of_a, of_b) for _, _, of_a, of_b in made], len(pairs)) for test in (mean_p_value, spread_p_value)
    )
    return [
        RateComparison(a, b, of_a.mean() - of_b.mean(), mean, of_a.std() - of_b.std(), spread)
        for (a, b, of_a, of_b), mean, spread in zip(made, means, spreads, strict=True)
    ]


def _table(a: Counts, b: Counts) -> list[list[int]]:
    return [[a.met, b.met], [a.seeds - a.met, b.seeds - b.met]]
