"""Film the scripted expert: `expert_video.py [TASK] [FOLDER]` writes TASK.mp4 and a contact sheet TASK.png.

The film is the close-up; the sheet shows the start of each phase, above it what the policy's camera saw.
"""

import sys
from pathlib import Path

import numpy as np
from lerobot.utils.io_utils import write_video
from PIL import Image

from lerobot_constructskill.contract import DEMO_SEED_START, FPS, get_task
from lerobot_constructskill.demos.demonstrate import demonstrate
from lerobot_constructskill.demos.expert import ExpertConfig, make_expert
from lerobot_constructskill.demos.noise import NoiseConfig
from lerobot_constructskill.envs.gym_env import ConstructSkillEnv

SIDE = 224


def main(task: str = "brick_to_bin", folder: str = "outputs") -> None:
    expert = make_expert(get_task(task), ExpertConfig())
    env = ConstructSkillEnv(task)
    film, sheet = [], {}

    def keep(phase, obs):
        film.append(env.render())
        sheet.setdefault(phase or "end", (obs["pixels"]["base"], film[-1]))

    demonstrate(env, expert, NoiseConfig(model="none"), DEMO_SEED_START, watch=keep)
    env.close()
    path = Path(folder) / f"{task}.mp4"
    path.parent.mkdir(parents=True, exist_ok=True)
    write_video(path, film, FPS)
    columns = [np.concatenate([_tile(image) for image in pair]) for pair in sheet.values()]
    Image.fromarray(np.concatenate(columns, axis=1)).save(path.with_suffix(".png"))
    print(f"{path} and {path.with_suffix('.png')}: {', '.join(sheet)}")


def _tile(image: np.ndarray) -> np.ndarray:
    return np.asarray(Image.fromarray(image).resize((SIDE, SIDE)))


if __name__ == "__main__":
    main(*sys.argv[1:])
