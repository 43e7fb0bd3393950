"""How encoding and training together grow with the number of demonstrations: seconds per frame and peak memory.

The demonstrations are short and of random colours, and the encoder is the small one with random weights: what is
measured is how the cost grows, not what it is.
"""

import numpy as np
import torch
from lerobot.datasets import LeRobotDataset
from measure import OUT, report, run
from safetensors.torch import save_file

from lerobot_constructskill.policies.frozen_vit.backbones import BACKBONES

DEMONSTRATIONS, LENGTH, SHAPE = (80, 320, 1280), 20, (224, 224, 3)
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


def measured(count: int) -> dict[str, tuple[float, float]]:
    """Stage to seconds and peak megabytes, for `count` demonstrations."""
    root = OUT / "scaling" / str(count)
    write_demonstrations(root / "demonstrations", count)
    encode = run(
        "constructskill-encode",
        "--repo_id=local/many",
        f"--root={root}/demonstrations",
        "--out_repo_id=local/many_tiny",
        f"--out_root={root}/features",
        "--backbone=vit_tiny16",
        f"--backbone_path={WEIGHTS}",
    )
    train = run("python", "benchmarks/ten_seeds.py", str(root), "10", "256", str(WEIGHTS))
    return {"encoding": encode, "training ten seeds together": train}


def main() -> None:
    torch.manual_seed(0)
    save_file(BACKBONES["vit_tiny16"].build().state_dict(), WEIGHTS)
    few, some, many = (measured(count) for count in DEMONSTRATIONS)
    for stage in few:
        frames = LENGTH * (DEMONSTRATIONS[2] - DEMONSTRATIONS[1])
        early = (some[stage].seconds - few[stage].seconds) / (LENGTH * (DEMONSTRATIONS[1] - DEMONSTRATIONS[0]))
        late = (many[stage].seconds - some[stage].seconds) / frames
        note = f"of each further demonstration, {DEMONSTRATIONS[1]} to {DEMONSTRATIONS[2]} against the first ones"
        report(f"{stage}, ms a frame", 1e3 * late, "at 80 to 320", 1e3 * early, note=note, less_is_better=True)
        peaks = few[stage].peak_mb, many[stage].peak_mb
        report(f"{stage}, peak memory in MB, 1280 demonstrations", peaks[1], "80", peaks[0], less_is_better=True)


if __name__ == "__main__":
    main()
