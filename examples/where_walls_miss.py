"""How far off the elements of walls lie, and how they were gripped.

Usage: python examples/where_walls_miss.py results/walls
       python examples/where_walls_miss.py results/walls outputs/store

The first reads the rows of a study: in how many episodes all elements lie upright within so many millimetres of their
places, and where the first one lies. The second also simulates what the runs in that store executed, without pictures:
how far off its middle an element is gripped, if those before it are placed and it ends upright.
"""

import json
import sys
from pathlib import Path

import numpy as np
import pandas as pd

from lerobot_constructskill.demos.precise import yaw_of
from lerobot_constructskill.envs.gym_env import ConstructSkillEnv
from lerobot_constructskill.envs.recording import RECORDINGS, Episode, read_recordings
from lerobot_constructskill.study.rows import ROWS, read_rows

WITHIN = (5, 10, 20, 50)
"""Millimetres off in x and y. From the last on, an element was not laid but carried elsewhere."""

ON, UPRIGHT = 4.0, 3.0
"""Millimetres off in height and degrees of tilt that a laid element may have."""

RISEN = 0.02
"""Metres that an element has risen when its grip is measured."""


def errors_of(measures: pd.Series) -> np.ndarray:
    """(episodes, elements, 5), as `plans.measure` gives them."""
    return np.array([json.loads(one)["errors"] for one in measures])


def laid(errors: np.ndarray, within: float) -> np.ndarray:
    """Whether each element lies upright within so many millimetres of its place."""
    off, stands = abs(errors[..., :2]).max(-1), abs(errors[..., 2]) < ON
    return (off <= within) & stands & (errors[..., 3] <= UPRIGHT)


def grips(simulator: ConstructSkillEnv, episode: Episode) -> dict[int, float]:
    """By element, the millimetres along its length from its middle to the hand, when it is first lifted."""
    simulator.reset(seed=episode.evaluation_seed)
    first = simulator.privileged_state()["object_poses"].reshape(-1, 7)
    found: dict[int, float] = {}
    for action in episode.executed:
        simulator.step(action)
        state = simulator.privileged_state()
        poses = state["object_poses"].reshape(-1, 7)
        for element in np.flatnonzero(poses[:, 2] - first[:, 2] > RISEN):
            yaw, off = yaw_of(poses[element]), state["tcp_pose"][:2] - poses[element, :2]
            found.setdefault(int(element), 1000 * float(off @ [np.cos(yaw), np.sin(yaw)]))
    return found


def gripped(file: Path) -> list[tuple[float, float]]:
    """Millimetres off the middle, and off the place along the wall, of each element of a run that counts."""
    episodes = read_recordings(file)
    simulator = ConstructSkillEnv(**episodes[0].environment, render_backend="none")
    found = []
    for episode in episodes:
        errors = errors_of(pd.Series([episode.measures]))[0]
        counts = laid(errors, WITHIN[-1]) & (np.arange(len(errors)) <= (episode.chain or 0))
        found += [(off, errors[one][0]) for one, off in grips(simulator, episode).items() if counts[one]]
    simulator.close()
    return found


def main(study: Path, store: Path | None = None) -> None:
    rows = read_rows(study / ROWS).dropna(subset="measures")
    for (setting, variant), own in rows[rows["lifted"]].groupby(["setting", "variant"]):
        errors = errors_of(own["measures"])
        whole = ", ".join(f"{laid(errors, mm).all(1).sum()} within {mm} mm" for mm in WITHIN)
        told = [f"{len(own)} episodes, whole walls: {whole}"]
        for seed in sorted(own["training_seed"].unique()):
            first = errors[own["training_seed"] == seed, 0]
            x = first[laid(first, WITHIN[-1]), 0]
            told.append(f"training seed {seed}: the first is {x.mean():+.1f} mm off along x, spread {x.std():.1f}")
        files = [store / "runs" / run / RECORDINGS for run in own["run"].unique()] if store else []
        if pairs := [pair for file in files if file.exists() for pair in gripped(file)]:
            off, along = np.median(np.abs(pairs), axis=0)
            told.append(
                f"{len(pairs)} elements, gripped {off:.1f} mm off their middle and laid {along:.1f} mm off along x "
                f"(medians); correlation {np.corrcoef(pairs, rowvar=False)[0, 1]:.2f}"
            )
        print(f"{setting}/{variant}\n  " + "\n  ".join(told))  # noqa: T201


if __name__ == "__main__":
    main(*map(Path, sys.argv[1:]))
