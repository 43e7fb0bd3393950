"""One episode of every checkpoint in a folder, in lockstep. Usage: python benchmarks/lockstep.py <folder> <steps>"""

import sys
from pathlib import Path

import lerobot_constructskill.plugin  # noqa: F401
from lerobot_constructskill.rollout.agents import PolicyAgent
from lerobot_constructskill.rollout.lockstep import roll_out


def main(folder: Path, steps: int) -> None:
    paths = sorted(folder.iterdir())
    agents = [PolicyAgent.from_pretrained(path, "cpu") for path in paths]
    total = 0
    for i, outcome in roll_out(agents, {"episode_length": steps}, seeds=[[1000]] * len(agents)):
        print(paths[i].name, *outcome.episodes, outcome.error or "")
        total += sum(episode.steps for episode in outcome.episodes)
    print("steps:", total)


if __name__ == "__main__":
    main(Path(sys.argv[1]), int(sys.argv[2]))
