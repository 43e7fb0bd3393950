"""From episodes to seeds: counts successful episodes of each run, and runs that met a criterion.

The seed is the sample. Episodes are counted within their run and never pooled over runs: at a fixed position the
episodes of a run repeat one trajectory (paper, section III).
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import pandas as pd

from lerobot_constructskill.study.rows import NOT_RUN

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
    made = rows[rows["error_kind"].fillna("") != NOT_RUN]
    groups = made.groupby(RUN, sort=True)
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


def spread_by_chance(met: np.ndarray) -> float:
    """Standard deviation over seeds (divisor n) of the share of episodes that is expected where seeds do not differ.

    Each start is then met by every seed with one probability of its own, which the seeds that met it estimate. A
    spread about as large tells nothing of the seeds: more starts make this one smaller.

    Args:
        met: whether each seed met the criterion from each start, bool (seeds, starts).
    """
    rates = met.mean(axis=0)
    return float(np.sqrt((rates * (1 - rates)).sum()) / len(rates))


def chance_of(episodes: pd.DataFrame, criterion: str) -> float | None:
    """`spread_by_chance` of a variant's episodes, or of its mean over settings.

    Args:
        episodes: rows of one variant.
        criterion: one of `CRITERIA`.

    Returns:
        None if fewer than two seeds finished, or they have different starts.
    """
    each = []
    for _, own in episodes[episodes["error_kind"].isna()].groupby("setting"):
        if own.duplicated(["training_seed", "evaluation_seed"]).any():
            return None
        met = own.pivot(index="training_seed", columns="evaluation_seed", values=criterion)
        if len(met) < 2 or met.isna().any(axis=None):
            return None
        each.append(spread_by_chance(met.to_numpy(bool)))
    return float(np.hypot.reduce(each)) / len(each) if each else None


def count(rates: np.ndarray) -> Counts:
    """Count the seeds that met a criterion in at least one episode (paper, Table I).

    Args:
        rates: share in [0, 1] of the episodes of each seed that met it, (seeds,).
    """
    return Counts(int(np.sum(rates > 0)), len(rates))
