"""Demonstrations merged per second of CPU time, and as LeRobot does it where it reads all columns of their episodes.

In one process and in turns, on copies of one real demonstration. Merging takes one core. The sets are the same.
"""

import shutil

from measure import OUT, CpuTimer, report
from merge_many import copies

from lerobot_constructskill.demos import merge
from lerobot_constructskill.demos.metadata import file_hashes
from lerobot_constructskill.lerobot_internals import load_episodes

COUNT, TURNS = 20, 3


def main() -> None:
    folder = OUT / "merging"
    shutil.rmtree(folder, ignore_errors=True)
    config, attempts = copies(folder / "shards", COUNT)
    ways = {"ours": merge.kept_of_episodes, "theirs": load_episodes}
    timers = {name: CpuTimer() for name in ways}
    for turn in range(TURNS + 1):  # the first imports
        for name, way in ways.items():
            merge.kept_of_episodes = way
            timer = timers[name] if turn else CpuTimer()
            with timer:
                merge.merge(config, attempts, folder / "shards", folder / f"{name}_{turn}")
    assert file_hashes(folder / "ours_0") == file_hashes(folder / "theirs_0")
    ours, theirs = (TURNS * COUNT / timers[name].seconds for name in ways)
    what = f"demonstrations merged per second of CPU time, {COUNT} in a set"
    report(what, ours, "LeRobot reads all columns of their episodes", theirs)


if __name__ == "__main__":
    main()
