"""Steps/s of sharp keypoints, forward and back, while all threads flush denormal numbers, as in a study.

Against it: the first thread alone flushes, because torch made the others before; and none does, as in `lerobot-train`.
They take turns, each in a process of its own. Maps are random, and patterns as sharp as those that 30 epochs of
`precise.yaml` leave: 3 % of the softmax is denormal.
"""

import time
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context

from measure import report

TURNS, STEPS = 3, 20
BATCH, PATCHES, DIM = 64, 784, 152
SHARPNESS = 1.35
ALL, FIRST, NONE = "all threads flush", "the first of the threads alone flushes", "no thread flushes"


def steps_a_second(flushing: str) -> float:
    """Steps of one batch in this process, with as many threads as torch takes."""
    import torch

    from lerobot_constructskill.policies.frozen_vit.readouts import SpatialSoftmax
    from lerobot_constructskill.training.trainers import flush_denormals

    if flushing == ALL:
        flush_denormals()
    torch.ones(1_000_000).add(1)  # makes the other threads
    if flushing == FIRST:
        flush_denormals()
    torch.manual_seed(0)
    patches, readout = torch.randn(BATCH, PATCHES, DIM), SpatialSoftmax(DIM)
    torch.nn.init.normal_(readout.patterns.weight, std=SHARPNESS)
    gradient = 1e-3 * torch.randn(BATCH, 2 * readout.patterns.out_features)
    readout(patches).backward(gradient)
    start = time.perf_counter()
    for _ in range(STEPS):
        readout(patches).backward(gradient)
    return STEPS / (time.perf_counter() - start)


def main() -> None:
    rates = {ALL: 0.0, FIRST: 0.0, NONE: 0.0}
    for _ in range(TURNS):
        for flushing in rates:
            with ProcessPoolExecutor(1, get_context("spawn")) as worker:
                rates[flushing] += worker.submit(steps_a_second, flushing).result() / TURNS
    for other in (FIRST, NONE):
        report(f"training steps/s of sharp keypoints, {ALL}", rates[ALL], other, rates[other])


if __name__ == "__main__":
    main()
