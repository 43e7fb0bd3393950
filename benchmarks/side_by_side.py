"""Steps/s of as many seeds of keypoints as there are cores, a process and a thread each, as a study trains them.

Against it: one seed after another, each with a thread for every core, as it was before. They take turns. A step reads
a batch of random maps as large as those of `precise.yaml`, in float16, and goes through readout and heads and back.
"""

import time
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context

from measure import report

from lerobot_constructskill.artifacts.pools import cores

TURNS, STEPS, WARM = 3, 40, 3
ROWS, BATCH, PATCHES, DIM = 1024, 64, 784, 152


def steps_a_second(threads: int) -> float:
    """Of one seed, in this process."""
    import torch

    from lerobot_constructskill.policies.frozen_vit.configuration_frozen_vit import FrozenViTChunkConfig
    from lerobot_constructskill.policies.frozen_vit.heads import ChunkHeads

    torch.set_flush_denormal(True)
    torch.set_num_threads(threads)
    torch.manual_seed(0)
    maps = torch.randn(ROWS, PATCHES, DIM, dtype=torch.float16)
    config = FrozenViTChunkConfig(device="cpu", readout="spatial_softmax", head_hidden_dim=256, head_hidden_layers=3)
    heads = ChunkHeads(config, DIM)
    optimizer = torch.optim.AdamW(heads.parameters(), 1e-3)
    start = 0.0
    for step in range(WARM + STEPS):
        if step == WARM:
            start = time.perf_counter()
        optimizer.zero_grad()
        heads(maps[torch.randint(ROWS, (BATCH,))].float())[0].abs().mean().backward()
        optimizer.step()
    return STEPS / (time.perf_counter() - start)


def main() -> None:
    beside = after = 0.0
    for _ in range(TURNS):
        with ProcessPoolExecutor(cores(), get_context("spawn")) as pool:
            beside += sum(pool.map(steps_a_second, [1] * cores())) / TURNS
        with ProcessPoolExecutor(1, get_context("spawn")) as pool:
            after += pool.submit(steps_a_second, cores()).result() / TURNS
    report("training steps/s of keypoints, a seed and a thread for each core", beside, "a seed at a time", after)


if __name__ == "__main__":
    main()
