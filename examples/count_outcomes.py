"""Lift and place counts per training seed, from what LeRobot's scripts wrote: `count_outcomes.py FOLDER`.

Reads FOLDER/eval/seed_*/eval_info.json (the reward of a step is the stage reached, so an episode's largest reward
tells whether it lifted and placed) and the held-out error in FOLDER/train_*.log.
"""

import json
import re
import sys
from pathlib import Path

from lerobot_constructskill.contract import REWARD_LIFTED, REWARD_PLACED


def main(folder: Path) -> None:
    print("| seed | lifted | placed | held-out translation error (1e-4 m2) |\n|---:|---:|---:|---:|")
    seeds = sorted(folder.glob("eval/seed_*"), key=lambda path: int(path.name.split("_")[1]))
    lifted_seeds = placed_seeds = 0
    for path in seeds:
        seed = path.name.split("_")[1]
        stages = json.loads((path / "eval_info.json").read_text())["per_task"][0]["metrics"]["max_rewards"]
        lifted = sum(stage >= REWARD_LIFTED for stage in stages)
        placed = sum(stage >= REWARD_PLACED for stage in stages)
        lifted_seeds += lifted > 0
        placed_seeds += placed > 0
        error = re.findall(r"heldout_translation_mse_m2=(\S+)", (folder / f"train_{seed}.log").read_text())[-1]
        print(f"| {seed} | {lifted}/{len(stages)} | {placed}/{len(stages)} | {float(error) * 1e4:.2f} |")
    print(f"\nSeeds that lifted: {lifted_seeds} of {len(seeds)}; that placed: {placed_seeds} of {len(seeds)}.")
    videos = sorted(folder.glob("eval/seed_*/videos/**/*.mp4"))
    print("Videos:", *videos, sep="\n  ")


if __name__ == "__main__":
    main(Path(sys.argv[1]))
