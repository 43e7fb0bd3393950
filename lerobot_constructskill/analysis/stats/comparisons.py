"""Two variants on one criterion: exact tests on seed counts, their correction, and a verdict in words."""

from collections.abc import Mapping, Sequence
from enum import StrEnum
from typing import NamedTuple

import numpy as np
from scipy.integrate import quad
from scipy.stats import beta, boschloo_exact, fisher_exact
from statsmodels.stats.multitest import multipletests

from lerobot_constructskill.analysis.stats.intervals import Estimate, newcombe
from lerobot_constructskill.analysis.stats.outcomes import Counts

ALIKE_WITHIN = 0.2
"""Two rates are called alike when the interval of their difference lies within so much of zero."""


class Verdict(StrEnum):
    """What the seeds say about a over b."""

    BETTER = "better"
    WORSE = "worse"
    ALIKE = "alike"
    INCONCLUSIVE = "inconclusive at this number of seeds"


class Comparison(NamedTuple):
    """One declared comparison.

    Args:
        a, b: the variants.
        counts_a, counts_b: their seeds that met the criterion.
        difference: rate of a minus rate of b, Newcombe's interval at 1 - alpha.
        fisher, boschloo: two-tailed p-values.
        holm: Boschloo's p-value, corrected over the declared family.
        probability_better: that a's rate is the higher one.
        verdict: from `holm` and `difference`.
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
    verdict: Verdict


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
        p_values: of the comparisons that could be made.
        family: how many were declared; the missing ones count as p = 1.
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


def verdict(corrected: float, difference: Estimate, alpha: float = 0.05) -> Verdict:
    """Judge one comparison by its corrected p-value and by the interval of its difference."""
    if corrected < alpha:
        return Verdict.BETTER if difference.value > 0 else Verdict.WORSE
    if max(-difference.low, difference.high) <= ALIKE_WITHIN:
        return Verdict.ALIKE
    return Verdict.INCONCLUSIVE


def compare(counts: Mapping[str, Counts], pairs: Sequence[tuple[str, str]], alpha: float = 0.05) -> list[Comparison]:
    """Make the declared comparisons that can be made.

    Args:
        counts: variant to counts on one criterion; variants without any result are absent.
        pairs: every declared comparison, the family that Holm's correction covers.
        alpha: level of the family.
    """
    made = [(a, b) for a, b in pairs if a in counts and b in counts]
    p_values = [boschloo(counts[a], counts[b]) for a, b in made]
    corrected = holm(p_values, family=len(pairs))
    return [
        _comparison(a, b, counts[a], counts[b], p_value, p_holm, alpha)
        for (a, b), p_value, p_holm in zip(made, p_values, corrected, strict=True)
    ]


def _comparison(a: str, b: str, counts_a: Counts, counts_b: Counts, p_value: float, p_holm: float, alpha: float):
    difference = newcombe(counts_a, counts_b, level=1 - alpha)
    return Comparison(
        a=a,
        b=b,
        counts_a=counts_a,
        counts_b=counts_b,
        difference=difference,
        fisher=fisher(counts_a, counts_b),
        boschloo=p_value,
        holm=p_holm,
        probability_better=probability_better(counts_a, counts_b),
        verdict=verdict(p_holm, difference, alpha),
    )


def _table(a: Counts, b: Counts) -> list[list[int]]:
    return [[a.met, b.met], [a.seeds - a.met, b.seeds - b.met]]
