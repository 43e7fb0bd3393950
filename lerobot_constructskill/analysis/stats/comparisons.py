"""Comparisons of two variants on one criterion: exact tests of seed counts, permutation tests of shares."""

from collections.abc import Callable, Mapping, Sequence
from enum import StrEnum
from typing import NamedTuple

import numpy as np
from scipy.integrate import quad
from scipy.stats import beta, boschloo_exact, fisher_exact, permutation_test
from scipy.stats.contingency import crosstab, expected_freq
from statsmodels.stats.multitest import multipletests

from lerobot_constructskill.analysis.stats.intervals import Estimate, mean_rate, newcombe
from lerobot_constructskill.analysis.stats.outcomes import Counts, count

ALIKE_WITHIN = 0.2
"""Two rates are alike if the interval of their difference lies within this distance of zero."""

PERMUTATIONS = 9999
"""Number of random permutations if there are too many to try all; then p >= 0.0001."""


class Conclusion(StrEnum):
    """What the seeds show of a against b."""

    BETTER = "better"
    WORSE = "worse"
    ALIKE = "alike"
    INCONCLUSIVE = "inconclusive at this number of seeds"


class Comparison(NamedTuple):
    """Two variants on one criterion.

    Args:
        a, b: the variants.
        counts_a, counts_b: their seeds that met the criterion in at least one episode.
        difference: rate of a's seeds minus rate of b's, with Newcombe's interval at 1 - alpha.
        fisher, boschloo: two-tailed p-values of the counts.
        holm: Boschloo's p-value, corrected over the declared comparisons.
        probability_better: probability that a's rate is higher.
        mean: mean over seeds of a's share of episodes minus that of b's, with its interval at 1 - alpha.
        mean_holm: p-value of `mean` from a permutation of seeds, corrected over the declared comparisons.
        conclusion: from `mean_holm` and `mean`. Counts decide nothing: where all seeds succeed once, they are equal.
        spread: standard deviation over seeds of a's share minus that of b's.
        spread_holm: p-value of `spread`, likewise.
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
    mean: Estimate
    mean_holm: float
    conclusion: Conclusion
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


def compare(
    rates: Mapping[str, np.ndarray], pairs: Sequence[tuple[str, str]], alpha: float = 0.05
) -> list[Comparison]:
    """Make those declared comparisons whose two variants have results.

    Args:
        rates: variant to the share in [0, 1] of successful episodes of each seed, (seeds,); variants without a result
            are absent.
        pairs: all declared comparisons, over which Holm's correction is taken.
        alpha: level of all of them together.
    """
    counts = {name: count(shares) for name, shares in rates.items()}
    made = [(a, b) for a, b in pairs if a in rates and b in rates]
    p_values = [boschloo(counts[a], counts[b]) for a, b in made]
    mean_p_values, spread_p_values = (
        [test(rates[a], rates[b]) for a, b in made] for test in (mean_p_value, spread_p_value)
    )
    corrected = [holm(found, len(pairs)) for found in (p_values, mean_p_values, spread_p_values)]
    compared = []
    for (a, b), p_value, of_counts, of_means, of_spreads in zip(made, p_values, *corrected, strict=True):
        mean = mean_difference(*(mean_rate(rates[name], 1 - alpha) for name in (a, b)))
        comparison = Comparison(
            a=a,
            b=b,
            counts_a=counts[a],
            counts_b=counts[b],
            difference=newcombe(counts[a], counts[b], level=1 - alpha),
            fisher=fisher(counts[a], counts[b]),
            boschloo=p_value,
            holm=of_counts,
            probability_better=probability_better(counts[a], counts[b]),
            mean=mean,
            mean_holm=of_means,
            conclusion=conclude(of_means, mean, alpha),
            spread=rates[a].std() - rates[b].std(),
            spread_holm=of_spreads,
        )
        compared.append(comparison)
    return compared


def mean_difference(a: Estimate, b: Estimate) -> Estimate:
    """Difference of two means from their intervals, by Newcombe's (1998) formula for rates."""
    value = a.value - b.value
    below, above = np.hypot(a.value - a.low, b.high - b.value), np.hypot(a.high - a.value, b.value - b.low)
    return Estimate(value, max(-1.0, float(value - below)), min(1.0, float(value + above)))


def mean_p_value(a: np.ndarray, b: np.ndarray) -> float:
    """Permutation test, two-tailed, of the difference of a's and b's mean over seeds.

    It suits settings in which a seed succeeds in some of its episodes, where "at least once" says little.

    Args:
        a, b: share in [0, 1] of each seed, (seeds,) each.
    """
    return _permuted(np.mean, a, b)


def spread_p_value(a: np.ndarray, b: np.ndarray) -> float:
    """Permutation test, two-tailed, of the difference of a's and b's standard deviation over seeds.

    The paper closes with a question: do vision-language-action policies reduce the variance over seeds? Where a seed
    succeeds in all its episodes or in none, the standard deviation is sqrt(p (1 - p)) of its rate p, so a variant that
    seldom or nearly always succeeds varies little: spread has to be read beside the mean.

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


def _table(a: Counts, b: Counts) -> list[list[int]]:
    return [[a.met, b.met], [a.seeds - a.met, b.seeds - b.met]]


def association(groups: Sequence, kinds: Sequence, strata: Sequence) -> float:
    """P-value of a permutation test whether what kind something is depends on its group, by the chi-squared statistic.

    Args:
        groups, kinds: of each thing; of one group or one kind alone, nothing can depend.
        strata: of each thing; kinds are exchanged within one alone, because things of one stratum are more alike.
    """
    counts = crosstab(groups, kinds).count
    if 1 in counts.shape:
        return 1.0
    expected = expected_freq(counts)
    of_group, of_kind, of_stratum = (np.unique(one, return_inverse=True)[1] for one in (groups, kinds, strata))
    in_order, rng = np.argsort(of_stratum, kind="stable"), np.random.default_rng(0)

    def statistic(kinds: np.ndarray) -> float:
        found = np.bincount(of_group * counts.shape[1] + kinds, minlength=counts.size).reshape(counts.shape)
        return float((np.square(found - expected) / expected).sum())

    exchanged, as_large, seen = np.empty_like(of_kind), 0, statistic(of_kind)
    for _ in range(PERMUTATIONS):
        exchanged[in_order] = of_kind[np.lexsort((rng.random(len(of_kind)), of_stratum))]
        as_large += statistic(exchanged) >= seen - 1e-9
    return (1 + as_large) / (1 + PERMUTATIONS)
