"""A picture and a film of every task of the contract, or of those that are named: `gallery.py [TASK ...]`.

They go to examples/pictures/TASK.jpg and docs/films/TASK.mp4. The picture: left what the policy sees at the start,
then close-ups of the scripted expert, half-way and at the end. The film: the same demonstration, what the policy sees
beside the close-up.
"""

import sys
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from PIL import Image
from tqdm import tqdm

from lerobot_constructskill.contract import DEMO_SEED_START, FPS, SHIPPED, Task
from lerobot_constructskill.demos.demonstrate import demonstrate
from lerobot_constructskill.demos.expert import ExpertConfig, make_expert
from lerobot_constructskill.demos.noise import NoiseConfig
from lerobot_constructskill.envs.gym_env import ConstructSkillEnv
from lerobot_constructskill.lerobot_internals import write_video

ROOT = Path(__file__).parents[1]
SIDE = 224
LONGEST = 280
"""Frames of a film."""


def main(names: Sequence[str]) -> None:
    if unknown := {*names} - {*SHIPPED}:
        sys.exit(f"There is no shipped task '{min(unknown)}'; the tasks are: {', '.join(SHIPPED)}.")
    for task in tqdm([SHIPPED[name] for name in names or SHIPPED]):
        seen, close_ups = demonstration(task)
        tiles = (seen[0], close_ups[len(close_ups) // 2], close_ups[-1])
        Image.fromarray(beside(*tiles)).save(ROOT / "examples" / "pictures" / f"{task.name}.jpg", quality=85)
        faster = -(-len(seen) // LONGEST)  # a wall takes more than a minute
        pairs = zip(seen[::faster], close_ups[::faster], strict=True)
        write_video(ROOT / "docs" / "films" / f"{task.name}.mp4", [beside(*pair) for pair in pairs], FPS)


def demonstration(task: Task) -> tuple[list[np.ndarray], list[np.ndarray]]:
    """What the policy sees in every step of the expert's demonstration, and the close-ups of it."""
    env, expert = ConstructSkillEnv(task.name, film=True), make_expert(task, ExpertConfig())
    seen, close_ups = [], []

    def keep(_, obs):
        seen.append(obs["pixels"]["base"])
        close_ups.append(env.render())

    demonstrate(env, expert, NoiseConfig(sigma=0.0), DEMO_SEED_START, watch=keep)
    env.close()
    return seen, close_ups


def beside(*images: np.ndarray) -> np.ndarray:
    """Images in one row, each `SIDE` pixels high."""
    scaled = [(SIDE * image.shape[1] // image.shape[0] // 2 * 2, SIDE) for image in images]
    pairs = zip(images, scaled, strict=True)
    return np.concatenate([np.asarray(Image.fromarray(image).resize(size)) for image, size in pairs], axis=1)


if __name__ == "__main__":
    main(sys.argv[1:])
