"""Killed just before any change to a folder, the next process ends as if nothing had been (see crash_points.py)."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

SCRIPT = Path(__file__).with_name("crash_points.py")

SCENARIOS = {"folder": None, "file": None, "store": None, "study": 30, "encode": 20, "generate": 15, "card": None}
"""How many of a scenario's crash points are tried: all, or so many at equal distances."""

FEWEST = 100


@pytest.fixture(scope="module")
def tried(tmp_path_factory):
    """Scenario to the number of its crash points that were tried."""
    counts = {}
    for name, most in SCENARIOS.items():
        command = [
            sys.executable,
            str(SCRIPT),
            name,
            str(tmp_path_factory.mktemp(name)),
            *([str(most)] if most else []),
        ]
        quiet = os.environ | {"HF_HUB_OFFLINE": "1", "OMP_NUM_THREADS": "1"}
        done = subprocess.run(command, env=quiet, capture_output=True, text=True)
        counts[name] = int(done.stdout.split()[-1]) if done.returncode == 0 else done.stderr[-2000:]
    return counts


@pytest.mark.slow
@pytest.mark.parametrize("name", SCENARIOS)
def test_killed_before_any_change_the_next_run_ends_as_the_undisturbed_one(name, tried):
    assert isinstance(tried[name], int), tried[name]


@pytest.mark.slow
def test_enough_crash_points_were_tried(tried):
    assert sum(tried.values()) >= FEWEST
