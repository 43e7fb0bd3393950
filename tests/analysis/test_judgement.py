"""One conclusion on two sides over their seeds, its interval, and what so many seeds could have shown."""

from itertools import starmap
from math import comb, inf

import numpy as np
import pytest

from lerobot_constructskill.analysis.stats.comparisons import Conclusion, mean_p_value
from lerobot_constructskill.analysis.stats.intervals import mean_rate
from lerobot_constructskill.analysis.stats.judgement import judge, mean_difference, smallest_p_value
from lerobot_constructskill.analysis.stats.power import (
    MOST,
    detectable_mean_difference,
    seeds_needed_for_mean,
)


def shares(*counts: int) -> np.ndarray:
    return np.array(counts) / 50


GOOD, BAD = shares(50, 49, 50, 48, 50, 47), shares(20, 31, 25, 28, 22, 24)


def test_the_conclusion_has_two_sides():
    better, worse = judge(GOOD, BAD), judge(BAD, GOOD)
    assert (better.conclusion, worse.conclusion) == (Conclusion.BETTER, Conclusion.WORSE)
    assert better.difference.value == -worse.difference.value == pytest.approx(np.mean(GOOD) - np.mean(BAD))
    assert better.difference.low == pytest.approx(-worse.difference.high)
    assert better.p_value == worse.p_value < 0.05 < better.counts_p_value, "every seed of both placed at least once"


def test_seeds_that_are_alike_need_to_be_many_before_they_are_called_so():
    assert judge(np.ones(5), np.ones(5)).conclusion is Conclusion.INCONCLUSIVE
    assert judge(np.ones(60), np.ones(60)).conclusion is Conclusion.ALIKE


@pytest.mark.parametrize("sizes", [(2, 2), (3, 3), (3, 4), (2, 6), (4, 4), (5, 5)])
def test_no_outcome_has_a_smaller_p_value_than_the_smallest(sizes):
    a, b = sizes
    apart = mean_p_value(np.linspace(0.9, 1.0, a), np.linspace(0.0, 0.1, b))
    assert smallest_p_value(a, b) == pytest.approx(apart)
    assert apart >= 1 / comb(a + b, a)


def test_one_seed_says_nothing():
    for b in (shares(50), GOOD):
        alone = judge(shares(0), b)
        assert alone.p_value == alone.smallest_p_value == 1 and alone.conclusion is Conclusion.INCONCLUSIVE
        assert alone.visible is alone.seeds_needed is None


def test_what_is_visible_depends_on_how_much_seeds_vary():
    calm, wild = judge(shares(40, 41, 42, 41, 40), shares(41, 40, 42, 41, 40)), judge(GOOD[:5], BAD[:5])
    assert calm.visible < wild.visible < judge(np.array([0, 1, 0, 1, 1.0]), np.array([0, 1, 0, 1, 0.0])).visible
    equal = judge(np.ones(5), np.ones(5))
    assert equal.visible is equal.seeds_needed is None


def test_a_visible_difference_is_found_in_four_of_five_comparisons():
    rng, deviation, seeds = np.random.default_rng(0), 0.1, 6
    difference = detectable_mean_difference(deviation, seeds, seeds)
    draws = rng.normal(0.5, deviation, (300, 2, seeds)) + [[[0.0], [difference]]]
    found = np.mean([mean_p_value(a, b) < 0.05 for a, b in draws])
    assert found == pytest.approx(0.8, abs=0.08)


def test_as_many_seeds_as_needed_make_a_difference_visible():
    needed = seeds_needed_for_mean(0.05, 0.1)
    enough, too_few = (detectable_mean_difference(0.1, n, n) for n in (needed, needed - 1))
    assert enough <= 0.05 < too_few
    assert seeds_needed_for_mean(0.0, 0.1) is None and seeds_needed_for_mean(0.001, 0.1) == inf
    assert 2 < needed < MOST


@pytest.mark.parametrize("seeds", [(3, 3), (3, 10), (10, 10)])
def test_the_interval_holds_the_difference_whatever_seeds_do(seeds):
    rng = np.random.default_rng(1)
    kinds = {
        0.5: lambda n: rng.random(n) < 0.5,
        0.9: lambda n: rng.random(n) < 0.9,
        20 / 22: lambda n: rng.beta(20, 2, n),
    }
    for mean_a, draw_a in kinds.items():
        for mean_b, draw_b in kinds.items():
            drawn = [(mean_rate(draw_a(seeds[0])), mean_rate(draw_b(seeds[1]))) for _ in range(60)]
            held = [low <= mean_a - mean_b <= high for _, low, high in starmap(mean_difference, drawn)]
            assert np.mean(held) >= 0.93
