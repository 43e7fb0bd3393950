"""Where the object stands in episodes that fail, by its distance from below the hand when an episode begins.

Usage: python examples/where_it_fails.py results/draws tenon_to_mortise

The starts' first states are simulated again, without pictures.
"""

import sys
from pathlib import Path

import numpy as np
import pandas as pd

from lerobot_constructskill.envs.gym_env import ConstructSkillEnv
from lerobot_constructskill.study.rows import VARIANT, read_environments, read_rows

EDGES = [0, 10, 20, 30, 40, 60, 80, 110, 150]
"""Millimetres."""


def distances(env: dict, starts: list[int]) -> dict[int, float]:
    """Horizontal millimetres from the hand to the object in the first state of each start."""
    simulator = ConstructSkillEnv(**env, render_backend="none")
    found = {}
    for start in starts:
        simulator.reset(seed=start)
        state = simulator.privileged_state()
        found[start] = 1000 * float(np.linalg.norm(state["tcp_pose"][:2] - state["object_pose"][:2]))
    simulator.close()
    return found


def main(root: Path, setting: str) -> None:
    rows = read_rows(root / "rows.parquet")
    rows = rows[(rows["setting"] == setting) & (rows["role"] == VARIANT) & rows["placed"].notna()]
    away = distances(read_environments(root)[setting], sorted(rows["evaluation_seed"].unique().tolist()))
    rows = rows.assign(**{"mm from below the hand": pd.cut(rows["evaluation_seed"].map(away), EDGES)})
    found = rows.groupby(["variant", "mm from below the hand"], observed=True)[["lifted", "placed"]]
    print(found.agg(["sum", "size"]).to_string())  # noqa: T201


if __name__ == "__main__":
    main(Path(sys.argv[1]), sys.argv[2])
