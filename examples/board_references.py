"""The board's floors and ceilings: what no policy at all, chance, an open-loop replay and the expert reach in a suite.

Usage: python examples/board_references.py <suite> <reference> <folder to record in>

Physics alone: none of them looks at a picture. about.yaml is written beside what is recorded, so that
`constructskill-submit --suite=<suite> --recorded=<folder> --about=<folder>/about.yaml --root=<entry>` makes the entry.
"""

import os
import sys
from concurrent.futures import ProcessPoolExecutor
from importlib.metadata import version
from itertools import batched
from multiprocessing import get_context
from pathlib import Path

import numpy as np
import yaml

from lerobot_constructskill.board.protocol import BOARD_SUITES, BoardSetting
from lerobot_constructskill.contract import DEMO_SEED_START, Task, get_task
from lerobot_constructskill.envs.gym_env import ConstructSkillEnv
from lerobot_constructskill.envs.recording import FOLDER
from lerobot_constructskill.errors import DISTRIBUTION
from lerobot_constructskill.rollout.agents import Agent, Observation
from lerobot_constructskill.rollout.references import REFERENCES, ExpertAgent, NoOpAgent, ReplayAgent

TRAINING_SEED = 0
TOGETHER = 10

SEES = {"expert": "privileged"}
"""What a reference observes; nothing by default."""


class OpenLoop(ReplayAgent):
    """What the expert executes from the first start of a data set, wherever it is; then it stands still."""

    def __init__(self, task: Task):
        NoOpAgent.__init__(self, task)
        env = ConstructSkillEnv(task.name, render_backend="none")
        self.actions = np.array(act(env, ExpertAgent(task), DEMO_SEED_START))
        env.close()


def act(env: ConstructSkillEnv, agent: Agent, seed: int) -> list[np.ndarray]:
    """Run an episode and return its actions."""
    env.reset(seed=seed)
    agent.reset(seed)
    actions, is_over = [], False
    while not is_over:
        actions.append(agent.act(Observation({}, env.privileged_state(), env.task_description)))
        _, _, terminated, truncated, _ = env.step(actions[-1])
        is_over = terminated or truncated
    return actions


def run(setting: BoardSetting, reference: str, starts: tuple[int, ...], folder: Path) -> None:
    """Record some episodes of a setting."""
    task = get_task(setting.task)
    agent = OpenLoop(task) if reference == "replay" else REFERENCES[reference].agent(task, TRAINING_SEED, None)
    os.environ[FOLDER] = str(folder)
    env = ConstructSkillEnv(**setting.environment, render_backend="none")
    for start in starts:
        act(env, agent, start)
    env.close()
    del os.environ[FOLDER]


def tell(reference: str, path: Path) -> None:
    """Write what a submission says of it."""
    about = {
        "name": REFERENCES[reference].label,
        "submitter": "lerobot_constructskill",
        "policy": f"the reference '{reference}'",
        "revision": f"examples/board_references.py of {DISTRIBUTION} {version(DISTRIBUTION)}",
        "data": f"the expert's actions from start {DEMO_SEED_START}" if reference == "replay" else "none",
        "training": "none",
        "compute": "physics alone, on a CPU",
        "observes": SEES.get(reference, "nothing"),
    }
    path.write_text(yaml.safe_dump(about, sort_keys=False), encoding="utf-8")


def main(suite: str, reference: str, root: Path) -> None:
    folder = root / f"seed_{TRAINING_SEED}"
    with ProcessPoolExecutor(2, get_context("spawn")) as pool:
        jobs = [
            pool.submit(run, setting, reference, starts, folder)
            for setting in BOARD_SUITES[suite].settings.values()
            for starts in batched(setting.starts, TOGETHER)  # noqa: B911  the last one may be shorter
        ]
        for job in jobs:
            job.result()
    tell(reference, root / "about.yaml")


if __name__ == "__main__":
    main(sys.argv[1], sys.argv[2], Path(sys.argv[3]))
