"""Killed just before any change to a folder, the next process ends as if nothing had been (see crash_points.py)."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

SCRIPT = Path(__file__).with_name("crash_points.py")

SCENARIOS = {"folder": None, "file": None, "store": None, "study": 30, "encode": 20, "generate": 15, "card": None}
"""How many of a scenario's crash points are tried: all, or so many at equal distances."""


@pytest.mark.slow
@pytest.mark.parametrize("name", SCENARIOS)
def test_killed_before_any_change_the_next_run_ends_as_the_undisturbed_one(name, tmp_path):
    most = [str(SCENARIOS[name])] * (SCENARIOS[name] is not None)
    quiet = os.environ | {"HF_HUB_OFFLINE": "1", "OMP_NUM_THREADS": "1"}
    done = subprocess.run([sys.executable, SCRIPT, name, tmp_path, *most], env=quiet, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr[-2000:]
