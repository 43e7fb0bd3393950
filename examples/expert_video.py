"""Film the scripted expert from close by: `expert_video.py [TASK] [FOLDER]` writes TASK.mp4.

`constructskill-check-task` draws the contact sheet: the start of each phase, above it what the policy's camera saw.
"""

import sys
from pathlib import Path

from lerobot.utils.io_utils import write_video

from lerobot_constructskill.contract import DEMO_SEED_START, FPS, get_task
from lerobot_constructskill.demos.demonstrate import demonstrate
from lerobot_constructskill.demos.expert import ExpertConfig, make_expert
from lerobot_constructskill.demos.noise import NoiseConfig
from lerobot_constructskill.envs.gym_env import ConstructSkillEnv


def main(task: str = "brick_to_bin", folder: str = "outputs") -> None:
    expert = make_expert(get_task(task), ExpertConfig())
    env = ConstructSkillEnv(task)
    film = []
    demonstrate(
        env, expert, NoiseConfig(sigma=0.0), DEMO_SEED_START, watch=lambda phase, obs: film.append(env.render())
    )
    env.close()
    path = Path(folder) / f"{task}.mp4"
    path.parent.mkdir(parents=True, exist_ok=True)
    write_video(path, film, FPS)
    print(path)


if __name__ == "__main__":
    main(*sys.argv[1:])
