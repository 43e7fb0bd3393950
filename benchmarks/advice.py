"""How often the expert's advice, followed from a disturbed state, places the object: one line a task and disturbance.

python benchmarks/advice.py 4 [task ...]
"""

import sys
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).parents[1] / "tests" / "demos"))

from disturbances import DISTURBANCES, recover  # noqa: E402

from lerobot_constructskill.contract import SHIPPED, get_task  # noqa: E402
from lerobot_constructskill.demos.expert import ExpertConfig, make_expert  # noqa: E402
from lerobot_constructskill.envs.gym_env import ConstructSkillEnv  # noqa: E402

FIRST_SEED = 3_000_000


def main(episodes: int, tasks: list[str]) -> None:
    for task in tasks or SHIPPED:
        env, expert = ConstructSkillEnv(task, render_backend="none"), make_expert(get_task(task), ExpertConfig())
        for name, disturbance in DISTURBANCES.items():
            seeds = range(FIRST_SEED, FIRST_SEED + episodes)
            outcomes = [recover(env, expert, disturbance, seed) for seed in seeds]
            steps = [steps for success, steps, _ in outcomes if success]
            hopeless = sum(hopeless and not success for success, _, hopeless in outcomes)
            median = f"{np.median(steps):.0f} steps" if steps else ""
            print(f"{task},{name},{len(steps)}/{episodes} placed,{hopeless} said hopeless,{median}", flush=True)
        env.close()


if __name__ == "__main__":
    main(int(sys.argv[1]), sys.argv[2:])
