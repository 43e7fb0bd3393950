"""The way of a training seed through the package gets no longer."""

import pytest
from walk import walk

WAYS = {"study.session:run_study": (16, 6), "dagger.run:run_dagger": (15, 5)}
"""Rooms and climbs, at most."""


@pytest.mark.parametrize("start", WAYS)
def test_the_way_gets_no_longer(start):
    rooms, climbs = walk(f"lerobot_constructskill.{start}")
    assert (len(rooms), climbs) <= WAYS[start] and climbs <= WAYS[start][1], rooms
