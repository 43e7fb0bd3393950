"""In how many frames of DAgger's rounds an object is turned by more than 3 degrees, too far for a close-fitting bin.

python benchmarks/turned.py FOLDER ...   each a data set of constructskill-dagger's, such as outputs/store/dagger/*
"""

import sys
from collections import Counter
from pathlib import Path

import numpy as np

from lerobot_constructskill.dataset.dataset import open_dataset
from lerobot_constructskill.demos.precise import yaw_of

TURNED = np.radians(3)


def main(folders: list[str]) -> None:
    frames, turned, sets = Counter(), Counter(), Counter()
    for folder in folders:
        data = open_dataset(Path(folder))
        if "dagger" not in data.facts:
            continue
        yaw = yaw_of(data.column("sim.object_pose")[data.rounds > 0])
        key = data.config.task, len(data.facts["dagger"]["rounds"])
        frames[key] += len(yaw)
        turned[key] += int((np.abs(np.sin(yaw)) > np.sin(TURNED)).sum())
        sets[key] += 1
    for (task, rounds), count in sorted(frames.items()):
        share = turned[task, rounds] / count
        print(f"{task}, {sets[task, rounds]} sets of {rounds} rounds: {share:.1%} of {count} frames of rounds")


if __name__ == "__main__":
    main(sys.argv[1:])
