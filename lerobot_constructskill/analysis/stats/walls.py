"""From episodes of a wall to what a mason asks: how far the chain came, where it broke, and how true it stands."""

import json
from collections.abc import Iterable
from typing import NamedTuple

import numpy as np
import pandas as pd

from lerobot_constructskill.analysis.stats.intervals import Estimate


class Wall(NamedTuple):
    """What the runs of a variant laid. Means are over training seeds, then over a seed's episodes.

    Args:
        elements: of the plan.
        chain: elements placed before the first that is not: mean, lowest and highest of a seed.
        share: of the elements that are placed at the end, 0 to 1: the same.
        ends: episodes whose chain ended at each element, and at last those whose chain is whole.
        off: median distance in x and y of the elements of chains from their places, mm; None where there are none.
        length, level, line: mean absolute of `plans.measure`, mm; None where no episode has it.
    """

    elements: int
    chain: Estimate
    share: Estimate
    ends: list[int]
    off: float | None
    length: float | None
    level: float | None
    line: float | None


def wall_of(episodes: pd.DataFrame) -> Wall | None:
    """What the episodes of one variant laid; None where these are of no plan.

    Args:
        episodes: rows of a study, of one variant in one setting.
    """
    measured = episodes[episodes["measures"].notna()]
    if measured.empty:
        return None
    read = [json.loads(text) for text in measured["measures"]]
    elements = len(read[0]["errors"])
    chains, placed = (measured[name].astype(float) for name in ("chain", "placements"))
    laid = zip(read, chains.astype(int), strict=True)
    off = [np.hypot(*error[:2]) for one, chain in laid for error in one["errors"][:chain]]
    return Wall(
        elements,
        over_seeds(chains, measured["training_seed"]),
        over_seeds(placed / elements, measured["training_seed"]),
        [int((chains == count).sum()) for count in range(elements + 1)],
        float(np.median(off)) if off else None,
        *(_mean(read, name) for name in ("length", "level", "line")),
    )


def over_seeds(values: Iterable[float], seeds: Iterable[int]) -> Estimate:
    """Mean over training seeds of the mean of a seed's episodes; its ends are the lowest and highest of a seed."""
    means = pd.Series([*values], dtype=float).groupby([*seeds]).mean()
    return Estimate(float(means.mean()), float(means.min()), float(means.max()))


def _mean(read: list[dict], name: str) -> float | None:
    known = [abs(one[name]) for one in read if one[name] is not None]
    return float(np.mean(known)) if known else None
