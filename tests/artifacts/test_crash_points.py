"""Killed just before any change to a folder, the next process ends as if nothing had been (see crash_points.py)."""

from pathlib import Path

import pytest
from commands import call

SCRIPT = Path(__file__).with_name("crash_points.py")

SCENARIOS = {"folder": [], "file": [], "store": [], "study": ["30"], "encode": ["20"], "generate": ["15"], "card": []}
"""How many of a scenario's crash points are tried: all, or so many at equal distances."""


@pytest.mark.slow
@pytest.mark.parametrize("name", SCENARIOS)
def test_killed_before_any_change_the_next_run_ends_as_the_undisturbed_one(name, tmp_path):
    call("code", SCRIPT.read_text(), name, str(tmp_path), *SCENARIOS[name])
