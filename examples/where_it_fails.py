"""Where the object stands in episodes that fail, by its distance from below the hand when an episode begins.

Usage: python examples/where_it_fails.py results/draws tenon_to_mortise
       python examples/where_it_fails.py board/entries/joints_precise tenon_to_mortise 5005

The first counts the episodes of a study. The second tells where the hand is in those of an entry of the board from one
start. Both simulate again, without pictures.
"""

import sys
from pathlib import Path

import numpy as np
import pandas as pd

from lerobot_constructskill.board.submission import read_submission
from lerobot_constructskill.contract import FPS
from lerobot_constructskill.envs.gym_env import ConstructSkillEnv
from lerobot_constructskill.study.rows import VARIANT, read_environments, read_rows

EDGES = [0, 10, 20, 30, 40, 60, 80, 110, 150, np.inf]
"""Millimetres."""


def distances(env: dict, starts: list[int]) -> dict[int, float]:
    """Horizontal millimetres from the hand to the object in the first state of each start."""
    simulator = ConstructSkillEnv(**env, render_backend="none")
    found = {}
    for start in starts:
        simulator.reset(seed=start)
        found[start] = place(simulator)[0]
    simulator.close()
    return found


def place(simulator: ConstructSkillEnv) -> tuple[float, float]:
    """How far the hand is from the object, horizontally, and how high it is, in millimetres."""
    state = simulator.privileged_state()
    away = np.linalg.norm(state["tcp_pose"][:2] - state["object_pose"][:2])
    return 1000 * float(away), 1000 * float(state["tcp_pose"][2])


def watch(entry: Path, setting: str, start: int) -> None:
    """Tell where the hand is in an entry's episodes from a start."""
    claims = [one for one in read_submission(entry).claims if (one.setting, one.evaluation_seed) == (setting, start)]
    if not claims:
        sys.exit(f"{entry} has no episode of {setting} from start {start}.")
    simulator = ConstructSkillEnv(**claims[0].environment, render_backend="none")
    for claim in claims:
        simulator.reset(seed=start)
        places = []
        for action in claim.executed:
            simulator.step(action)
            places.append(place(simulator))
        away, high = zip(*places[FPS:], strict=True)
        print(  # noqa: T201
            f"training seed {claim.training_seed}, {claim.stage}: {places[FPS - 1][0]:.0f} mm from the object after a "
            f"second, then up to {max(away):.0f}, and {min(high):.0f} to {max(high):.0f} high"
        )


def main(root: Path, setting: str) -> None:
    rows = read_rows(root / "rows.parquet")
    rows = rows[(rows["setting"] == setting) & (rows["role"] == VARIANT) & rows["placed"].notna()]
    away = distances(read_environments(root)[setting], sorted(rows["evaluation_seed"].unique().tolist()))
    rows = rows.assign(
        **{"mm from below the hand": pd.cut(rows["evaluation_seed"].map(away), EDGES, include_lowest=True)}
    )
    found = rows.groupby(["variant", "mm from below the hand"], observed=True)[["lifted", "placed"]]
    print(found.agg(["sum", "size"]).to_string())  # noqa: T201


if __name__ == "__main__":
    if len(sys.argv) > 3:
        watch(Path(sys.argv[1]), sys.argv[2], int(sys.argv[3]))
    else:
        main(Path(sys.argv[1]), sys.argv[2])
