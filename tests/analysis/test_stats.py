"""Statistics on seeds: the paper's own numbers, and what must hold for any numbers."""

from functools import partial
from itertools import combinations, product

import numpy as np
import pandas as pd
import pytest
from scipy.stats import binom, bootstrap, kendalltau

from lerobot_constructskill.analysis.stats.comparisons import (
    Conclusion,
    boschloo,
    compare,
    fisher,
    holm,
    mean_p_value,
    probability_better,
    spread_p_value,
)
from lerobot_constructskill.analysis.stats.components import intervals, split
from lerobot_constructskill.analysis.stats.correlation import _tau_b, kendall
from lerobot_constructskill.analysis.stats.intervals import clopper_pearson, mean_rate, newcombe
from lerobot_constructskill.analysis.stats.outcomes import Counts, chance_of, count, runs_of, spread_by_chance
from lerobot_constructskill.analysis.stats.power import (
    _rejected,
    detectable_spread_ratio,
    power,
    seeds_needed,
    wrong_order,
)
from lerobot_constructskill.study.rows import NOT_RUN

# Paper, Tables I and II: seeds that lifted, seeds that placed, seeds.
BACKBONES = {"dinov2": (10, 7, 10), "clip": (6, 5, 10), "vit_tiny": (3, 1, 10), "vit_tiny_augreg": (2, 1, 10)}
LIFTED = {name: Counts(lifted, seeds) for name, (lifted, _, seeds) in BACKBONES.items()}
PLACED = {name: Counts(placed, seeds) for name, (_, placed, seeds) in BACKBONES.items()}
BASELINE, NOISE_FREE = Counts(3, 3), Counts(0, 3)
PAIRS = list(combinations(BACKBONES, 2))

# Where shares and numbers of seeds are at their ends, and between.
ARMS = [Counts(met, seeds) for seeds in (1, 3, 10) for met in {0, 1, seeds // 2, seeds}]


def shares(counts: Counts) -> np.ndarray:
    """Seeds of which so many succeed always, and the others never."""
    return np.repeat([1.0, 0.0], [counts.met, counts.seeds - counts.met])


@pytest.fixture
def rng() -> np.random.Generator:
    return np.random.default_rng(0)


@pytest.mark.parametrize(
    ("counts", "other", "p_value", "digits"),
    [(LIFTED, "vit_tiny", 0.0031, 4), (LIFTED, "vit_tiny_augreg", 0.0007, 4), (LIFTED, "clip", 0.087, 3)]
    + [(PLACED, "clip", 0.65, 2)],
)
def test_fisher_gives_the_papers_four_p_values(counts, other, p_value, digits):
    assert round(fisher(counts["dinov2"], counts[other]), digits) == p_value


def test_what_the_paper_does_not_say():
    """Spec, section 5, last paragraph."""
    assert round(fisher(BASELINE, NOISE_FREE), 2) == 0.10
    comparison = compare({name: shares(counts) for name, counts in LIFTED.items()}, PAIRS)[
        PAIRS.index(("dinov2", "clip"))
    ]
    assert round(comparison.boschloo, 3) == 0.042
    assert round(comparison.holm, 2) == 0.17
    assert comparison.conclusion is Conclusion.INCONCLUSIVE
    assert seeds_needed(0.7, 0.5) == 102, "about 93 by the normal approximation"
    assert round(wrong_order(0.7, 0.5, 10), 2) == 0.12
    assert round(wrong_order(0.7, 0.5, 3), 2) == 0.17
    assert round(probability_better(PLACED["dinov2"], PLACED["clip"]), 2) == 0.81


def test_published_intervals():
    """Newcombe 1998, table II, row (a), method 10: 56/70 - 48/80; Clopper-Pearson of 10/10 is 0.025^(1/10)."""
    assert newcombe(Counts(56, 70), Counts(48, 80))[1:] == pytest.approx((0.0524, 0.3339), abs=1e-4)
    assert clopper_pearson(Counts(10, 10)).low == pytest.approx(0.025**0.1)


@pytest.mark.parametrize("counts", ARMS, ids=str)
def test_intervals_hold_their_estimate_and_lie_in_range(counts):
    estimate = clopper_pearson(counts)
    assert 0 <= estimate.low <= estimate.value == counts.rate <= estimate.high <= 1
    wide, narrow = clopper_pearson(counts, 0.99), clopper_pearson(counts, 0.9)
    assert wide.low <= narrow.low and narrow.high <= wide.high


def test_intervals_narrow_with_seeds():
    intervals = [clopper_pearson(Counts(n // 2, n)) for n in (2, 10, 30, 100)]
    widths = [interval.high - interval.low for interval in intervals]
    assert widths == sorted(widths, reverse=True)


def test_an_interval_needs_a_seed():
    for call in (clopper_pearson, lambda counts: newcombe(counts, BASELINE)):
        with pytest.raises(ValueError, match="at least one seed"):
            call(Counts(0, 0))


@pytest.mark.parametrize(("a", "b"), list(combinations(ARMS, 2)), ids=str)
def test_swapping_the_arms_changes_signs_only(a, b):
    assert fisher(a, b) == pytest.approx(fisher(b, a))
    assert boschloo(a, b) == pytest.approx(boschloo(b, a), abs=1e-6)
    assert probability_better(a, b) == pytest.approx(1 - probability_better(b, a), abs=1e-6)
    assert newcombe(a, b) == pytest.approx([-newcombe(b, a)[i] for i in (0, 2, 1)])
    assert newcombe(a, b).low <= newcombe(a, b).value <= newcombe(a, b).high


@pytest.mark.parametrize("seeds", [3, 10])
def test_boschloo_is_never_weaker_than_fisher(seeds):
    for met_a, met_b in combinations(range(seeds + 1), 2):
        a, b = Counts(met_a, seeds), Counts(met_b, seeds)
        assert boschloo(a, b) <= fisher(a, b) + 1e-6


def test_probability_better_of_many_seeds():
    assert probability_better(Counts(5000, 10000), Counts(4000, 10000)) == pytest.approx(1)
    assert probability_better(Counts(4000, 10000), Counts(4000, 10000)) == pytest.approx(0.5)


def test_holm_only_raises_and_counts_what_was_not_made():
    p_values = [0.04, 0.001, 0.3]
    assert holm(p_values) == pytest.approx([0.08, 0.003, 0.3])
    assert holm(p_values, family=6) == pytest.approx([0.2, 0.006, 1.0])
    assert all(corrected >= raw for corrected, raw in zip(holm(p_values), p_values, strict=True))
    assert holm([]) == []


def test_conclusions():
    counts = {"all": Counts(30, 30), "every": Counts(30, 30), "half": Counts(15, 30), "three": Counts(3, 3)}
    pairs = [("all", "half"), ("half", "all"), ("all", "every"), ("half", "three"), ("all", "absent")]
    comparisons = compare({name: shares(own) for name, own in counts.items()}, pairs)
    conclusions = [Conclusion.BETTER, Conclusion.WORSE, Conclusion.ALIKE, Conclusion.INCONCLUSIVE]
    assert [comparison.conclusion for comparison in comparisons] == conclusions
    assert comparisons[0].holm == pytest.approx(5 * comparisons[0].boschloo)


def test_a_verdict_is_of_means_where_every_seed_succeeds_once():
    (compared,) = compare({"often": np.full(12, 0.9), "seldom": np.full(12, 0.2)}, [("often", "seldom")])
    assert compared.conclusion is Conclusion.BETTER and compared.holm == 1


def test_alike_seeds_spread_as_single_episodes_do():
    """Over many studies of five seeds the variance between seeds is that which each study expects by chance."""
    rng = np.random.default_rng(0)
    met = rng.random((4000, 5, 20)) < rng.random(20)
    by_chance = np.mean([spread_by_chance([[dict(enumerate(seed)) for seed in study]]) ** 2 for study in met])
    assert by_chance == pytest.approx(met.mean(axis=2).var(axis=1).mean(), rel=0.03)


def episodes_of(placed: dict[str, list[list[bool]]], first: int = 0) -> pd.DataFrame:
    """Rows of a variant: setting to what each seed placed."""
    columns = ["setting", "training_seed", "evaluation_seed", "placed", "error_kind"]
    rows = [
        (setting, seed, first + start, one, None)
        for setting, seeds in placed.items()
        for seed, own in enumerate(seeds)
        for start, one in enumerate(own)
    ]
    return pd.DataFrame(rows, columns=columns)


def test_what_chance_gives_is_of_seeds_that_finished_the_same_starts():
    one = episodes_of({"a": [[True, True, False, True], [True, False, False, True]]})
    assert chance_of(one, "placed") == pytest.approx(0.5 / 4), "one of four starts, in half of the seeds"
    other = one.assign(setting="b", evaluation_seed=one["evaluation_seed"] + 100)
    assert chance_of(pd.concat([one, other]), "placed") == pytest.approx(0.5 / 4 / np.sqrt(2)), "independent tasks"
    assert chance_of(pd.concat([one, one.assign(setting="b")]), "placed") == pytest.approx(0.5 / 4), (
        "the same episodes"
    )
    assert chance_of(one[one["training_seed"] == 0], "placed") is None, "one seed"
    assert chance_of(one[one["evaluation_seed"] == 1], "placed") is None, "one start"
    assert chance_of(one.drop(index=0), "placed") is None, "other starts"
    assert chance_of(one.assign(error_kind=["fault", *[None] * 7]), "placed") is None, "a seed that failed"
    assert chance_of(one.assign(error_kind=NOT_RUN), "placed") is None


@pytest.mark.slow
def test_as_many_seeds_as_needed_have_the_power():
    needed = seeds_needed(1.0, 0.5)
    assert seeds_needed(0.5, 1.0) == needed > seeds_needed(1.0, 0.2)
    assert power(1.0, 0.5, needed) >= 0.8 > power(1.0, 0.5, needed - 1)
    assert seeds_needed(0.3, 0.3) is None and seeds_needed(0.93, 0.9) == np.inf
    over_rates = [seeds_needed(1.0, rate / 30) for rate in range(30)]
    assert over_rates == sorted(over_rates) and over_rates[0] >= 2


def test_power_grows_with_seeds_and_difference():
    assert power(0.7, 0.7, 20) < 0.05
    over_seeds = [power(0.9, 0.4, seeds) for seeds in (3, 10, 20, 30)]
    over_rates = [power(0.9, rate, 20) for rate in (0.8, 0.6, 0.4, 0.2)]
    assert over_seeds == sorted(over_seeds) and over_rates == sorted(over_rates)


@pytest.mark.parametrize("seeds", [1, 4, 13])
def test_power_is_of_fishers_test(seeds):
    """Of certain counts the power is 0 or 1: whether the test rejects them."""
    for met_a, met_b in product(range(seeds + 1), repeat=2):
        rejected = fisher(Counts(met_a, seeds), Counts(met_b, seeds)) < 0.05
        assert _rejected(seeds, 0.05)[met_a, met_b] == rejected


def test_wrong_orders(rng):
    chances = [wrong_order(0.7, 0.5, seeds) for seeds in (3, 10, 30, 100)]
    assert chances == sorted(chances, reverse=True) and 0 < chances[-1] < 0.01
    assert wrong_order(0.7, 0.5, 1) == pytest.approx(0.3 * 0.5)
    assert wrong_order(0.5, 0.7, 10) == wrong_order(0.7, 0.5, 10)
    seeds = rng.binomial(10, [[0.7], [0.5]], (2, 100_000))
    assert wrong_order(0.7, 0.5, 10) == pytest.approx(np.mean(seeds[0] < seeds[1]), abs=0.005)
    ties = sum(binom.pmf(range(11), 10, 0.6) ** 2)
    assert wrong_order(0.6, 0.6, 10) == pytest.approx((1 - ties) / 2)


RATES = [np.ones(10), np.zeros(3), np.array([1.0]), np.array([1.0, 0, 0, 1, 0.3]), np.linspace(0, 1, 30)]


@pytest.mark.parametrize("rates", RATES, ids=len)
def test_the_interval_of_a_mean_holds_it_in_any_order(rates, rng):
    estimate = mean_rate(rates)
    assert 0 <= estimate.low <= estimate.value <= estimate.high <= 1
    assert estimate.low < estimate.high
    assert mean_rate(rng.permutation(rates))[1:] == estimate[1:]


@pytest.mark.parametrize("rates", RATES, ids=len)
def test_the_interval_of_a_mean_is_of_random_weights(rates, rng):
    weights = rng.dirichlet(np.ones(len(rates) + 1), size=200_000)
    drawn = np.quantile(weights @ [*rates, 0], 0.025), np.quantile(weights @ [*rates, 1], 0.975)
    assert mean_rate(rates)[1:] == pytest.approx(drawn, abs=0.005)


@pytest.mark.parametrize("met", [0, 1, 7, 10])
def test_mean_of_all_or_nothing_seeds_has_the_interval_of_their_count(met):
    assert mean_rate(np.repeat([1.0, 0.0], [met, 10 - met])) == pytest.approx(clopper_pearson(Counts(met, 10)))


def bootstrap_with_two_seeds_added(rates, rng):
    """As reports had it before: Bayesian, one seed added at 0 and one at 1, widened to hold the mean."""
    low, high = np.quantile(rng.dirichlet(np.ones(len(rates) + 2), size=2000) @ [*rates, 0, 1], [0.025, 0.975])
    return rates.mean(), min(low, rates.mean()), max(high, rates.mean())


@pytest.mark.slow
@pytest.mark.parametrize("mean", [0.03, 0.5, 0.966])
def test_the_interval_of_a_mean_covers_it(mean, rng):
    """Also where seeds differ a little and succeed nearly always or hardly ever, as a bootstrap's does not."""
    shares = rng.binomial(50, rng.beta(30 * mean, 30 * (1 - mean), size=(300, 10))) / 50
    covered, before = (
        np.mean([low <= mean <= high for _, low, high in (interval(own) for own in shares)])
        for interval in (mean_rate, partial(bootstrap_with_two_seeds_added, rng=rng))
    )
    assert covered >= 0.95 and (before < 0.85 or mean == 0.5)


@pytest.mark.parametrize("method", ["percentile", "basic", "BCa"])
@pytest.mark.filterwarnings("ignore:.*BCa|.*encountered in")
def test_scipys_bootstrap_is_certain_of_ten_equal_seeds(method, rng):
    """Why the resampling of mean and spread is our own."""
    interval = bootstrap((np.ones(10),), np.mean, method=method, rng=rng).confidence_interval
    assert not interval.high - interval.low > 0
    assert mean_rate(np.ones(10)).low == pytest.approx(0.025 ** (1 / 10))


@pytest.mark.slow
def test_a_ratio_of_spreads_is_found_in_four_of_five_studies():
    rng = np.random.default_rng(1)
    ratio = detectable_spread_ratio(10, 10)
    found = [spread_p_value(ratio * rng.normal(size=10), rng.normal(size=10)) < 0.05 for _ in range(100)]
    assert 2 < ratio < 5 and 0.7 < np.mean(found) < 0.98
    assert detectable_spread_ratio(30, 30) < ratio < detectable_spread_ratio(5, 5)
    assert detectable_spread_ratio(3, 3) == np.inf, "twenty orders of six seeds give no small p-value"


def test_spread_test():
    half, full = np.repeat([1.0, 0.0], [5, 5]), np.ones(10)
    assert spread_p_value(half, half) == 1
    assert spread_p_value(half, full) == pytest.approx(fisher(Counts(5, 10), Counts(10, 10)), abs=0.01)
    assert spread_p_value(full, half) == pytest.approx(spread_p_value(half, full), abs=0.01)
    assert spread_p_value(np.repeat([1.0, 0.0], [1, 9]), np.repeat([1.0, 0.0], [9, 1])) == 1
    assert spread_p_value(np.repeat([1.0, 0.0], [15, 15]), np.full(30, 0.5)) < 0.001


def test_mean_test():
    half, full = np.repeat([1.0, 0.0], [5, 5]), np.ones(10)
    assert mean_p_value(half, full) == pytest.approx(fisher(Counts(5, 10), Counts(10, 10)), abs=0.01)
    assert mean_p_value(np.linspace(0, 0.2, 8), np.linspace(0.3, 0.5, 8)) < 0.01
    assert mean_p_value(np.ones(1), np.zeros(1)) == 1


@pytest.mark.slow
@pytest.mark.parametrize("test", [mean_p_value, spread_p_value])
def test_permutation_tests_keep_their_level(test, rng):
    p_values = [test(*rng.choice([0.0, 0.5, 1.0], (2, 4))) for _ in range(200)]
    assert np.mean(np.array(p_values) < 0.05) <= 0.08


def test_kendall_finds_order_and_none(rng):
    error, one = np.arange(20.0), np.full(20, "one")
    ordered = kendall(error, -error, one, rng)
    assert ordered.tau.value == pytest.approx(-1) and ordered.p_value < 0.01
    none = kendall(error, np.tile([0.0, 10.0], 10), one, rng)
    assert -1 <= none.tau.low < 0 < none.tau.high <= 1 and none.p_value > 0.1


def test_a_better_variant_with_a_lower_error_is_no_order_within_variants(rng):
    """Why the test is our own: scipy's takes pairs of two variants with the others."""
    variant = np.repeat(["good", "bad"], 20)
    error = np.repeat([1.0, 9.0], 20) + rng.random(40)
    success = np.repeat([8.0, 1.0], 20) + rng.integers(0, 2, 40)
    assert abs(kendalltau(error, success).statistic) > 0.5 and kendalltau(error, success).pvalue < 1e-4
    within = kendall(error, success, variant, rng)
    assert abs(within.tau.value) < 0.4 and within.p_value > 0.05


@pytest.mark.slow
@pytest.mark.parametrize("successes", [1, 3])
def test_kendalls_p_value_keeps_its_level_where_few_succeed(successes, rng):
    p_values = []
    for _ in range(100):
        success = rng.permutation([1.0] * successes + [0.0] * (20 - successes))
        p_values.append(kendall(rng.random(20), success, np.repeat(["a", "b"], 10), rng).p_value)
    assert np.mean(np.array(p_values) < 0.05) <= 0.1


def test_resampled_tau_is_scipys(rng):
    x, y = rng.integers(0, 4, (2, 5, 12)).astype(float)
    assert _tau_b(x, y, [np.arange(12)]) == pytest.approx(
        [kendalltau(a, b).statistic for a, b in zip(x, y, strict=True)]
    )


def test_kendall_needs_errors_and_outcomes_that_differ(rng):
    nothing = np.full(10, np.nan)
    for error, success in [(nothing, np.arange(10)), (np.arange(10), np.ones(10)), (np.arange(4), np.arange(4))]:
        assert kendall(error, success, np.zeros(len(error)), rng) is None
    assert kendall(np.arange(10), np.repeat([0, 1], 5), np.repeat([0, 1], 5), rng) is None  # only between variants
    error, one = np.array([*range(9), np.nan]), np.zeros(10)
    assert kendall(error, -error, one, np.random.default_rng(0)) == kendall(
        error[:9], -error[:9], one[:9], np.random.default_rng(0)
    )


def drawn_episodes(rng, draws, seeds, starts, deviations):
    """Draws, seeds on each and starts of each that move the chance of an episode by so much (standard deviations)."""
    rows = []
    for draw in range(draws):
        of_draw, of_starts = rng.normal(0, deviations[0]), rng.normal(0, deviations[2], starts)
        for seed in range(seeds):
            chances = np.clip(0.5 + of_draw + rng.normal(0, deviations[1]) + of_starts, 0, 1)
            met = rng.random(starts) < chances
            rows += [(draw, draw * seeds + seed, draw * starts + start, bool(met[start])) for start in range(starts)]
    return pd.DataFrame(rows, columns=["draw", "training_seed", "evaluation_seed", "met"])


@pytest.mark.parametrize("deviations", [(0.15, 0.03, 0.1), (0.03, 0.15, 0.1), (0.1, 0.1, 0.0)])
def test_the_spread_is_split_as_an_analysis_of_variance_splits_it(deviations, rng):
    """Its mean squares give the same where every draw has as many seeds and starts (Searle et al. 1992)."""
    draws, seeds, starts = shape = 24, 4, 24
    episodes = drawn_episodes(rng, *shape, deviations)
    met = episodes["met"].to_numpy(float).reshape(shape)
    of_draws, of_seeds, of_starts = met.mean((1, 2)), met.mean(2), met.mean(1)
    rest = met - of_seeds[:, :, None] - of_starts[:, None, :] + of_draws[:, None, None]
    squares = {
        "draws": seeds * starts * of_draws.var(ddof=1),
        "seeds": starts * np.square(of_seeds - of_draws[:, None]).sum() / (draws * (seeds - 1)),
        "starts": seeds * np.square(of_starts - of_draws[:, None]).sum() / (draws * (starts - 1)),
        "rest": np.square(rest).sum() / (draws * (seeds - 1) * (starts - 1)),
    }
    variances = (
        (squares["draws"] - squares["seeds"] - squares["starts"] + squares["rest"]) / (seeds * starts),
        (squares["seeds"] - squares["rest"]) / starts,
        (squares["starts"] - squares["rest"]) / seeds / starts,
        squares["rest"] / starts,
    )
    found = split(episodes)
    assert found.episodes[1:] == pytest.approx(np.sqrt(intervals(met)["episodes"]))
    for estimate, variance in zip(found, variances, strict=True):
        assert estimate.value == pytest.approx(np.sqrt(max(variance, 0)), abs=0.0005)
        assert estimate.low <= estimate.value <= estimate.high


@pytest.mark.parametrize(
    ("placed", "deviations"), [(0.94, (0.02, 0.02, 0.02)), (0.94, (0, 0, 0)), (0.5, (0.15, 0.03, 0.05))]
)
def test_intervals_over_ten_draws_cover_what_they_should(placed, deviations, rng):
    """Two seeds a draw and fifty starts, as in `draws`."""
    left = placed * (1 - placed) - sum(one**2 for one in deviations)
    of_draws, of_seeds, of_starts = (one**2 for one in deviations)
    true = {"draws": of_draws, "seeds": of_seeds, "starts": of_starts / 50, "episodes": left / 50}
    found = []
    for _ in range(200):
        parts = ((10, 1, 1), (10, 2, 1), (10, 1, 50))
        chances = placed + sum(one * rng.choice([-1, 1], shape) for one, shape in zip(deviations, parts, strict=True))
        found.append(intervals((rng.random((10, 2, 50)) < chances).astype(float)))
    for name, value in true.items():
        assert np.mean([one[name][0] <= value <= max(one[name][1], 0) for one in found]) > 0.85, name


def test_an_interval_over_draws_that_vary_most_is_that_of_a_variance_of_so_many_numbers(rng):
    """Of ten, half to twice as much; of two, next to nothing is known."""
    met = np.sort(rng.random((10, 3, 60)), axis=0) < 0.5
    ten, two = (intervals(some.astype(float))["draws"] for some in (met, met[[0, -1]]))
    deviation = met.mean((1, 2)).std(ddof=1)
    assert np.sqrt(ten) / deviation == pytest.approx([0.69, 1.83], abs=0.04)  # chi-squared, 9 degrees of freedom
    assert two[1] > 0.5**2, "which a report calls not determined"


def test_draws_that_are_alike_have_an_interval_without_width():
    met = np.array([[0, 1, 1], [1, 1, 0]], float)
    found = intervals([met, met])
    assert all(np.isfinite(ends).all() for ends in found.values()) and np.ptp(found["episodes"]) == 0


def test_what_cannot_be_told_apart_is_not(rng):
    assert split(drawn_episodes(rng, 1, 4, 20, (0.1, 0.1, 0.1))) is None, "one draw"
    assert split(drawn_episodes(rng, 4, 1, 20, (0.1, 0.1, 0.1))) is None, "a seed a draw"
    episodes = drawn_episodes(rng, 4, 2, 20, (0.1, 0.1, 0.1))
    assert split(episodes.assign(met=True)) is None, "all alike"
    assert split(episodes.assign(met=episodes["training_seed"] % 2 == 0)) is None, "a seed does it always or never"
    assert split(episodes.assign(evaluation_seed=episodes["evaluation_seed"] % 20)) is None, "draws share starts"


def test_a_failed_run_is_a_seed_that_did_not_meet_the_criterion_and_a_missing_run_is_not():
    episode = {"setting": "s", "variant": "v", "error_kind": None, "error": None}
    episode |= {"heldout_mse_m2": 1e-4, "heldout_mse_m2_by_data": None}
    rows = [episode | {"training_seed": 0, "lifted": True, "placed": index > 0} for index in range(2)]
    for seed, kind in ((1, "machine"), (2, NOT_RUN)):
        rows.append(episode | {"training_seed": seed, "lifted": None, "placed": None, "error_kind": kind})
    kinds = {"lifted": "boolean", "placed": "boolean", "error_kind": "string", "error": "string"}
    table = pd.DataFrame(rows).astype(kinds)
    runs = runs_of(table)
    assert count(runs["lifted_rate"]) == count(runs["placed_rate"]) == Counts(1, 2)
    assert runs["placed_rate"].tolist() == [0.5, 0.0] and runs["episodes"].tolist() == [2, 0]
    assert runs["error_kind"].isna().tolist() == [True, False]
    assert count(runs_of(table[table["training_seed"] == 1])["lifted_rate"]) == Counts(0, 1)
    assert runs_of(table[table["training_seed"] == 2]).empty
