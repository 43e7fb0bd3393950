"""From episodes to seeds: counts successful episodes of each run, and runs that met a criterion.

The seed is the sample. Episodes are counted within their run and never pooled over runs: at a fixed position the
episodes of a run repeat one trajectory (paper, section III).
"""

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np
import pandas as pd

from lerobot_constructskill.study.rows import ran

CRITERIA = ("lifted", "placed")
"""The two success metrics of an episode, each a column of the rows."""

RUN = ["setting", "variant", "training_seed"]
"""Columns that identify a run."""


class Counts(NamedTuple):
    """Seeds that met a criterion, out of all seeds; failed runs count as `seeds` and not as `met`."""

    met: int
    seeds: int

    @property
    def rate(self) -> float:
        return self.met / self.seeds


def runs_of(rows: pd.DataFrame) -> pd.DataFrame:
    """One row for every run that was made, ordered by setting, variant and seed.

    Args:
        rows: one row per evaluation episode, as `study.rows.read_rows` returns them.

    Returns:
        The columns of `RUN`; `episodes` that were run; `lifted` and `placed`, episodes that met the criterion;
        `lifted_rate` and `placed_rate`, their share in [0, 1], 0 where the run failed; `heldout_mse_m2`;
        `heldout_mse_m2_by_data`, as in the rows; `error_kind` and `error` of a failed run, else null.
    """
    groups = ran(rows).groupby(RUN, sort=True)
    runs = pd.DataFrame({"episodes": groups["placed"].count()})
    for criterion in CRITERIA:
        runs[criterion] = groups[criterion].sum().astype(int)
        runs[f"{criterion}_rate"] = (runs[criterion] / runs["episodes"].clip(lower=1)).astype(float)
    runs["heldout_mse_m2"] = groups["heldout_mse_m2"].first().astype(float)
    for column in ("heldout_mse_m2_by_data", "error_kind", "error"):
        runs[column] = groups[column].first()
    return runs.reset_index()


def by_unit(rates: Sequence[float] | np.ndarray, units: Sequence[int]) -> np.ndarray:
    """Mean of the rates of each unit that is independent of the others: a training seed, or a draw with all its seeds.

    Args:
        rates: share in [0, 1] of the episodes of each seed, (seeds,).
        units: the unit of each seed, `study.rows.Draws.unit`.
    """
    return pd.Series(rates, dtype=float).groupby(list(units), sort=False).mean().to_numpy()


def spread_by_chance(tasks: Sequence[Sequence[Mapping[int, bool]]]) -> float | None:
    """The standard deviation over seeds (divisor n) of the share of episodes, were all seeds alike.

    From each start every seed then succeeds with one probability, and its spread is that of single episodes: the root
    of the sum of their variances over seeds, which is the variance that is expected. A spread about as large tells
    nothing of the seeds; more starts make this one smaller.

    Args:
        tasks: of each task, and there of each seed: start to whether the episode succeeded. The share is the mean over
            tasks. Their episodes from one start stand together, because tasks can look alike there.

    Returns:
        None where seeds have different starts, and for one seed or one start, from which seeds and episodes cannot be
        told apart.
    """
    parts: dict[int, np.ndarray] = {}
    for seeds in tasks:
        first = seeds[0]
        if any(met.keys() != first.keys() for met in seeds):
            return None
        for start in first:
            met = np.array([own[start] for own in seeds], dtype=float)
            parts[start] = parts.get(start, 0) + met / len(first) / len(tasks)
    if len(parts) < 2 or min(map(len, tasks)) < 2:
        return None
    return float(np.sqrt(np.var([*parts.values()], axis=1).sum()))


def chance_of(episodes: pd.DataFrame, criterion: str) -> float | None:
    """`spread_by_chance` of a variant's share, or of its mean over settings.

    Args:
        episodes: rows of one variant, of the seeds that count.
        criterion: one of `CRITERIA`.

    Returns:
        None too where a seed failed, or has a start twice.
    """
    made = ran(episodes)
    if made["error_kind"].notna().any() or made.duplicated(["setting", "training_seed", "evaluation_seed"]).any():
        return None
    return spread_by_chance(
        [
            [dict(zip(own["evaluation_seed"], own[criterion], strict=True)) for _, own in of.groupby("training_seed")]
            for _, of in made.groupby("setting")
        ]
    )


def count(rates: np.ndarray) -> Counts:
    """Count the seeds that met a criterion in at least one episode (paper, Table I).

    Args:
        rates: share in [0, 1] of the episodes of each seed that met it, (seeds,).
    """
    return Counts(int(np.sum(rates > 0)), len(rates))
