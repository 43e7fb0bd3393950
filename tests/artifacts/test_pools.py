"""Where attempts run."""

import subprocess
import sys

HELD_TO_ONE = """
import os
os.sched_setaffinity(0, {min(os.sched_getaffinity(0))})
from lerobot_constructskill.artifacts.pools import cores
print(cores())
"""


FAILS_EARLY = """
import sys, time
from pathlib import Path
from lerobot_constructskill.artifacts.pools import open_pool

def job(path):
    path.touch()
    time.sleep(0.2)

if __name__ == "__main__":
    with open_pool("processes", 2) as submit:
        running = [submit(job, Path(sys.argv[1]) / str(number)) for number in range(100)]
        running[0].result()
        raise KeyboardInterrupt
"""


def test_what_has_not_begun_is_dropped_when_the_block_fails(tmp_path) -> None:
    script, folder = tmp_path / "early.py", tmp_path / "made"
    script.write_text(FAILS_EARLY)
    folder.mkdir()
    assert subprocess.run([sys.executable, script, folder], capture_output=True).returncode != 0
    assert 1 <= len(list(folder.iterdir())) < 50


def test_a_process_that_is_held_to_one_core_counts_one() -> None:
    assert subprocess.run([sys.executable, "-c", HELD_TO_ONE], capture_output=True, text=True).stdout == "1\n"
