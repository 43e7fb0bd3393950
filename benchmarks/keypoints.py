"""Keypoints in training: steps/s of the readout, forward and back, and batches/s that a loader reads.

The readout stands against its formula written out in PyTorch, on batches as `precise.yaml` has them, with the threads
that torch takes and with one, as in a study. Denormal numbers are flushed on both sides. Batches of 64 frames of
features stand against LeRobot's reading, frame by frame, in one process. All take turns.
"""

import time
from collections.abc import Callable

import torch
from lerobot.datasets import LeRobotDataset
from measure import OUT, report
from torch import Tensor

from lerobot_constructskill.policies.frozen_vit.batches import read_whole_batches
from lerobot_constructskill.policies.frozen_vit.readouts import SpatialSoftmax, _expected_positions

TURNS = 20
BATCH, PATCHES, DIM = 64, 784, 152


def main() -> None:
    torch.set_flush_denormal(True)
    readouts()
    batches()


def readouts() -> None:
    torch.manual_seed(0)
    patches, readout = torch.randn(BATCH, PATCHES, DIM).half(), SpatialSoftmax(DIM)
    gradient = 1e-3 * torch.randn(BATCH, 2 * readout.patterns.out_features)

    def step(positions: Callable[[], Tensor]) -> None:
        positions().backward(gradient)

    def formula() -> Tensor:
        return _expected_positions(readout.patterns(patches.float()))

    threads = torch.get_num_threads()
    for number in dict.fromkeys((threads, 1)):
        torch.set_num_threads(number)
        ours, theirs = in_turns(lambda: step(lambda: readout(patches)), lambda: step(formula))
        what = "training steps/s of keypoints, " + ("one thread" if number == 1 else f"{number} threads")
        report(what, ours, "the formula in PyTorch", theirs)
    torch.set_num_threads(threads)


def batches() -> None:
    chunks = {"action": [step / 20 for step in range(8)]}
    data = LeRobotDataset("local/fast", root=OUT / "features", delta_timestamps=chunks)
    read_whole_batches()
    rows = torch.randperm(len(data))[:BATCH].tolist()
    ours, theirs = in_turns(lambda: data.__getitems__(rows), lambda: [data[row] for row in rows])
    report("batches of 64 frames of features read per second", ours, "LeRobot, frame by frame", theirs)


def in_turns(ours: Callable[[], object], theirs: Callable[[], object]) -> list[float]:
    """Calls per second of each."""
    seconds = [0.0, 0.0]
    for turn in range(TURNS + 1):
        for side, call in enumerate((ours, theirs)):
            start = time.perf_counter()
            call()
            seconds[side] += (time.perf_counter() - start) * (turn > 0)  # the first is no measurement
    return [TURNS / each for each in seconds]


if __name__ == "__main__":
    main()
