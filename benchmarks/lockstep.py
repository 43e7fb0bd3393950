"""One episode of every checkpoint in a folder, in lockstep. Usage: python benchmarks/lockstep.py <folder> <steps>"""

import sys
from pathlib import Path

import lerobot_constructskill.plugin  # noqa: F401
from lerobot_constructskill.study.agents import PolicyAgent
from lerobot_constructskill.study.rollout import roll_out


def main(folder: Path, steps: int) -> None:
    agents = [PolicyAgent.from_pretrained(path, "cpu") for path in sorted(folder.iterdir())]
    outcomes = roll_out(agents, {"episode_length": steps}, seeds=[1000])
    for path, outcome in zip(sorted(folder.iterdir()), outcomes, strict=True):
        print(path.name, *outcome.episodes, outcome.error or "")
    print("steps:", sum(episode.steps for outcome in outcomes for episode in outcome.episodes))


if __name__ == "__main__":
    main(Path(sys.argv[1]), int(sys.argv[2]))
