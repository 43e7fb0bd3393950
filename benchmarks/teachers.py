"""How far apart the expert's two labels of a frame are, in demonstrations without noise: what it does, knowing its
phase, and what it advises from the state alone. One line a phase: frames, and how many differ by more than 2 mm.

python benchmarks/teachers.py brick_to_bin_shifted 15
"""

import sys

import numpy as np

from lerobot_constructskill.contract import DEMO_SEED_START, get_task
from lerobot_constructskill.demos.demonstrate import demonstrate
from lerobot_constructskill.demos.expert import ExpertConfig, Phase, make_expert
from lerobot_constructskill.demos.noise import NoiseConfig
from lerobot_constructskill.envs.gym_env import ConstructSkillEnv

APART = 0.002


def main(task: str, episodes: int) -> None:
    env, expert = ConstructSkillEnv(task, render_backend="none"), make_expert(get_task(task), ExpertConfig())
    noise, seeds = NoiseConfig(sigma=0), range(DEMO_SEED_START, DEMO_SEED_START + episodes)
    frames = [frame for seed in seeds for frame in demonstrate(env, expert, noise, seed, "advice")[0]]
    env.close()
    for phase in Phase:
        labels = [(f["action"], f["dart.executed_action"]) for f in frames if f["phase"] == phase]
        apart = sum(np.linalg.norm((advised - done)[:3]) > APART for advised, done in labels)
        print(f"{task},{phase},{len(labels)} frames,{apart} more than {1000 * APART:g} mm apart")


if __name__ == "__main__":
    main(sys.argv[1], int(sys.argv[2]))
