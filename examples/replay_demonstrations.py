"""Replay a data set in the simulator: `replay_demonstrations.py FOLDER`.

Prints what was added to the clean actions in each phase, then executes every demonstration again from its seed and
says how many outcomes came out as recorded; exits with 1 if any did not.
"""

import json
import sys
from pathlib import Path

import numpy as np
from lerobot.datasets.lerobot_dataset import LeRobotDataset
from tqdm import tqdm

from lerobot_constructskill.demos.columns import SIDECAR
from lerobot_constructskill.demos.expert import Phase
from lerobot_constructskill.envs.gym_env import ConstructSkillEnv

COLUMNS = ["action", "dart.executed_action", "phase", "episode_index", "sim.seed", "next.success", "next.reward"]


def main(root: Path) -> int:
    table = LeRobotDataset(f"local/{root.name}", root=root).hf_dataset.select_columns(COLUMNS).with_format("numpy")[:]
    facts = json.loads((root / SIDECAR).read_text())["generator"]
    added = (table["dart.executed_action"] - table["action"])[:, :3] * 1000
    for phase in Phase:
        noise = added[table["phase"] == phase]
        print(f"{phase:<9} {len(noise):6} frames, added mean {noise.mean(0).round(2)} std {noise.std(0).round(2)} mm")
    env = ConstructSkillEnv(facts["task"], light_robot=facts["light_robot"])
    episodes = np.unique(table["episode_index"])
    same = sum(replay(env, table, table["episode_index"] == episode) for episode in tqdm(episodes))
    env.close()
    print(f"{same} of {len(episodes)} demonstrations ended as recorded.")
    return int(same < len(episodes))


def replay(env: ConstructSkillEnv, table: dict[str, np.ndarray], rows: np.ndarray) -> bool:
    """Whether the executed actions give the recorded reward and success at every step."""
    env.reset(seed=int(table["sim.seed"][rows][0]))
    steps = [env.step(action) for action in table["dart.executed_action"][rows]]
    rewards, successes = [step[1] for step in steps], [step[2] for step in steps]
    return bool((rewards == table["next.reward"][rows]).all() and (successes == table["next.success"][rows]).all())


if __name__ == "__main__":
    raise SystemExit(main(Path(sys.argv[1])))
