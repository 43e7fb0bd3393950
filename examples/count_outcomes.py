"""Lift and place counts per training seed, from what LeRobot's scripts wrote: `count_outcomes.py FOLDER`.

Reads FOLDER/eval/seed_*/eval_info.json (the reward of a step is the stage reached, so an episode's largest reward
tells whether it lifted and placed) and the held-out loss in FOLDER/train_*.log. The films of a seed's episodes go into
FOLDER/seed_N.mp4, side by side.
"""

import re
import sys
from pathlib import Path

from films import frames, side_by_side

from lerobot_constructskill.contract import FPS
from lerobot_constructskill.lerobot_internals import write_video
from lerobot_constructskill.scripts.push_policy import seed_outcomes


def main(folder: Path) -> None:
    print("| seed | lifted | placed | held-out loss |\n|---:|---:|---:|---:|")
    outcomes = seed_outcomes(folder / "eval")
    for seed, lifted, placed, episodes in outcomes:
        loss = re.findall(r"eval_loss=(\S+)", (folder / f"train_{seed}.log").read_text())[-1]
        print(f"| {seed} | {lifted}/{episodes} | {placed}/{episodes} | {loss} |")
    lifted_seeds, placed_seeds = (sum(outcome[i] > 0 for outcome in outcomes) for i in (1, 2))
    print(f"\nSeeds that lifted: {lifted_seeds} of {len(outcomes)}; that placed: {placed_seeds} of {len(outcomes)}.")
    films = {seed: sorted(folder.glob(f"eval/seed_{seed}/videos/**/*.mp4")) for seed, *_ in outcomes}
    print("The episodes of a seed side by side:")
    for seed, paths in films.items():
        if paths:
            write_video(film := folder / f"seed_{seed}.mp4", side_by_side([frames(path) for path in paths]), FPS)
            print(f"  {film}")


if __name__ == "__main__":
    main(Path(sys.argv[1]))
