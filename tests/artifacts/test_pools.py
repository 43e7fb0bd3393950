"""Where attempts run."""

import subprocess
import sys

HELD_TO_ONE = """
import os
os.sched_setaffinity(0, {min(os.sched_getaffinity(0))})
from lerobot_constructskill.artifacts.pools import cores
print(cores())
"""


def test_a_process_that_is_held_to_one_core_counts_one() -> None:
    assert subprocess.run([sys.executable, "-c", HELD_TO_ONE], capture_output=True, text=True).stdout == "1\n"
