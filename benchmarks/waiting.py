"""Training steps/s of keypoints and a small head while torch's threads sleep when they wait, as in our commands.

Against it: they spin, as OpenMP has them do by default. Each alone, and beside a busy process for every second core.
They take turns, each in a process of its own. Maps are random, of the size that keypoints.py takes.
"""

import os
import subprocess
import sys
import time
from concurrent.futures import ProcessPoolExecutor
from contextlib import ExitStack
from multiprocessing import get_context

from keypoints import BATCH, DIM, PATCHES
from measure import report

from lerobot_constructskill.artifacts.pools import cores

TURNS, SECONDS = 3, 8
HIDDEN, ACTIONS = 256, 32
SLEEP, SPIN = {"OMP_WAIT_POLICY": "PASSIVE"}, {}
BUSY = "while True: pass"


def steps_a_second() -> float:
    """Steps of one batch in this process, with as many threads as torch takes."""
    import torch
    from torch import nn

    from lerobot_constructskill.policies.frozen_vit.readouts import SpatialSoftmax

    torch.manual_seed(0)
    readout = SpatialSoftmax(DIM)
    heads = nn.Sequential(nn.Linear(2 * readout.patterns.out_features, HIDDEN), nn.ReLU(), nn.Linear(HIDDEN, ACTIONS))
    optimizer = torch.optim.AdamW([*readout.parameters(), *heads.parameters()], lr=1e-3)
    patches, actions = torch.randn(BATCH, PATCHES, DIM), torch.randn(BATCH, ACTIONS)

    def step() -> None:
        loss = nn.functional.l1_loss(heads(readout(patches)), actions)
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()

    step()  # makes the threads
    steps, start = 0, time.perf_counter()
    while time.perf_counter() - start < SECONDS:
        step()
        steps += 1
    return steps / (time.perf_counter() - start)


def measure(policy: dict[str, str], neighbours: int) -> float:
    """The steps a second under a policy of waiting, beside some busy processes."""
    os.environ.pop("OMP_WAIT_POLICY", None)
    os.environ |= policy
    with ExitStack() as stack:
        for _ in range(neighbours):
            stack.callback(stack.enter_context(subprocess.Popen([sys.executable, "-c", BUSY])).kill)
        worker = stack.enter_context(ProcessPoolExecutor(1, get_context("spawn")))
        return worker.submit(steps_a_second).result()


def main() -> None:
    every_second = max(1, cores() // 2)
    for neighbours, where in ((0, "alone"), (every_second, "beside a busy process for every second core")):
        turns = [(measure(SLEEP, neighbours), measure(SPIN, neighbours)) for _ in range(TURNS)]
        sleeping, spinning = (sum(rates) / TURNS for rates in zip(*turns, strict=True))
        what = f"training steps/s of keypoints and heads, {where}, threads sleep while they wait"
        report(what, sleeping, "threads spin, as OpenMP's default", spinning)


if __name__ == "__main__":
    main()
