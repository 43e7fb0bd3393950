"""The way of a training seed through the package gets no longer."""

import pytest
from walk import walk

WAYS = {"study.session:run_study": (17, 6), "dagger.run:run_dagger": (16, 6)}
"""Rooms and climbs, at most; `plans` is one that every task of several objects needs."""


@pytest.mark.parametrize("start", WAYS)
def test_the_way_gets_no_longer(start):
    rooms, climbs = walk(f"lerobot_constructskill.{start}")
    assert (len(rooms), climbs) <= WAYS[start] and climbs <= WAYS[start][1], rooms
