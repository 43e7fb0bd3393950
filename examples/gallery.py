"""One picture a task for the README: `gallery.py [FOLDER]` writes FOLDER/TASK.jpg for every task of the contract.

Left what the policy sees at the start, then close-ups of the scripted expert: half-way, and the end.
"""

import sys
from pathlib import Path

import numpy as np
from PIL import Image
from tqdm import tqdm

from lerobot_constructskill.contract import DEMO_SEED_START, TASKS, Task
from lerobot_constructskill.demos.demonstrate import demonstrate
from lerobot_constructskill.demos.expert import ExpertConfig, make_expert
from lerobot_constructskill.demos.noise import NoiseConfig
from lerobot_constructskill.envs.gym_env import ConstructSkillEnv

SIDE = 224


def main(folder: str = "examples/pictures") -> None:
    for task in tqdm(TASKS.values()):
        tiles = [np.asarray(Image.fromarray(image).resize((SIDE, SIDE))) for image in film(task)]
        Image.fromarray(np.concatenate(tiles, axis=1)).save(Path(folder) / f"{task.name}.jpg", quality=85)


def film(task: Task) -> list[np.ndarray]:
    """What the policy sees at the start, and the expert's demonstration at half time and at its end."""
    env, expert = ConstructSkillEnv(task.name), make_expert(task, ExpertConfig())
    seen, close_ups = [], []

    def keep(_, obs):
        seen.append(obs["pixels"]["base"])
        close_ups.append(env.render())

    demonstrate(env, expert, NoiseConfig(sigma=0.0), DEMO_SEED_START, watch=keep)
    env.close()
    return [seen[0], close_ups[len(close_ups) // 2], close_ups[-1]]


if __name__ == "__main__":
    main(*sys.argv[1:])
