"""How each stage grows with the number of demonstrations: seconds for each further one, and peak memory.

Generation is measured on real demonstrations, few of them, and merging on copies of one. Encoding
and training are measured on up to 1280, short ones of random colours, with the small encoder and random weights.
What is measured is how the cost grows, not what it is.
"""

import shutil

import numpy as np
import torch
from lerobot.datasets import LeRobotDataset
from measure import OUT, Ran, report, run
from safetensors.torch import save_file

from lerobot_constructskill.policies.frozen_vit.backbones import BACKBONES

GENERATED, MERGED, DEMONSTRATIONS = (4, 12, 36), (10, 40, 160), (80, 320, 1280)
LENGTH, SHAPE = 20, (224, 224, 3)
WEIGHTS = OUT / "vit_tiny16.safetensors"


def write_demonstrations(root, count: int) -> None:
    features = {
        "observation.images.base": {
            "dtype": "video",
            "shape": (224, 224, 3),
            "names": ["height", "width", "channels"],
        },
        "action": {"dtype": "float32", "shape": (4,), "names": ["dx", "dy", "dz", "gripper"]},
    }
    dataset = LeRobotDataset.create("local/many", fps=20, root=root, features=features, streaming_encoding=True)
    rng = np.random.default_rng(0)
    for _ in range(count):
        for _ in range(LENGTH):
            frame = np.full(SHAPE, rng.integers(256, size=3), dtype=np.uint8)
            action = rng.uniform(-0.05, 0.05, size=4).astype(np.float32)
            dataset.add_frame({"observation.images.base": frame, "action": action, "task": "none"})
        dataset.save_episode()
    dataset.finalize()


def generation(count: int) -> Ran:
    out = OUT / "scaling" / f"generated_{count}"
    config = ["fast", f"--episodes={count}", "--workers=2"]
    return run("constructskill-generate", *config, "--repo_id=local/some", f"--root={out}")


def merging(count: int) -> Ran:
    return run("python", "benchmarks/merge_many.py", str(OUT / "scaling" / f"merged_{count}"), str(count))


def encoding(count: int) -> Ran:
    root = OUT / "scaling" / str(count)
    write_demonstrations(root / "demonstrations", count)
    return run(
        "constructskill-encode",
        "--repo_id=local/many",
        f"--root={root}/demonstrations",
        "--out_repo_id=local/many_tiny",
        f"--out_root={root}/features",
        "--backbone=vit_tiny16",
        f"--backbone_path={WEIGHTS}",
    )


def training(count: int) -> Ran:
    return run("python", "benchmarks/ten_seeds.py", str(OUT / "scaling" / str(count)), "10", "256", str(WEIGHTS))


STAGES = {encoding: DEMONSTRATIONS, training: DEMONSTRATIONS, merging: MERGED, generation: GENERATED}


def main() -> None:
    torch.manual_seed(0)
    shutil.rmtree(OUT / "scaling", ignore_errors=True)
    save_file(BACKBONES["vit_tiny16"].build().state_dict(), WEIGHTS)
    for stage, counts in STAGES.items():
        few, some, many = (stage(count) for count in counts)
        early = (some.seconds - few.seconds) / (counts[1] - counts[0])
        late = (many.seconds - some.seconds) / (counts[2] - counts[1])
        name, steps = stage.__name__, f"{counts[1]} to {counts[2]}"
        what = f"{name}, ms for each further demonstration, {steps}"
        report(what, 1e3 * late, f"{counts[0]} to {counts[1]}", 1e3 * early, less_is_better=True)
        what = f"{name}, peak memory in MB, {counts[2]} demonstrations"
        report(what, many.peak_mb, f"{counts[0]} demonstrations", few.peak_mb, less_is_better=True)


if __name__ == "__main__":
    main()
