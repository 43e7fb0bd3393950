"""What a data set owes in which a learner drove: every round is what its provenance says."""

from collections.abc import Iterator

import numpy as np

from lerobot_constructskill.dataset.dataset import DataSet
from lerobot_constructskill.demos.columns import ACTORS, EXPERT


def check_rounds(data: DataSet) -> Iterator[str]:
    """Rounds, actors and seeds of the frames against the provenance; nothing where no learner drove."""
    if "dagger" not in data.facts:
        return
    actors, listed = data.column("dagger.actor"), data.facts["dagger"]["rounds"]
    if not np.isin(actors, ACTORS).all():
        yield f"dagger.actor is not one of {', '.join(ACTORS)} everywhere."
    if (actors[data.rounds == 0] != EXPERT).any():
        yield "Somebody other than the expert acts in a demonstration."
    if (np.diff(data.rounds) < 0).any() or set(data.rounds) - {0} - {entry["round"] for entry in listed}:
        yield "The rounds of the frames are not those of the provenance, one after another."
    acted_by_expert = (actors == EXPERT) & (data.rounds > 0)
    off = np.abs(data.column("dart.executed_action") - data.column("action"))[acted_by_expert]
    if off.max(initial=0) > 1e-6:
        yield "Frames of a round in which the expert acted do not execute its action."
    for entry in listed:
        yield from _check_round(data, actors, entry)


def _check_round(data: DataSet, actors: np.ndarray, entry: dict) -> Iterator[str]:
    number, rows = entry["round"], data.rounds == entry["round"]
    frames, by_expert = int(rows.sum()), int((actors[rows] == EXPERT).sum())
    if (frames, by_expert) != (entry["frames"], entry["by_expert"]):
        yield (
            f"Round {number} has {frames} frames, {by_expert} by the expert; its provenance says {entry['frames']} "
            f"and {entry['by_expert']}."
        )
    seeds = np.unique(data.column("sim.seed")[rows]).tolist()
    wanted = list(range(entry["seed_start"], entry["seed_start"] + entry["episodes"]))
    if sorted([*seeds, *entry["discarded_seeds"]]) != wanted:
        yield f"The seeds of round {number} and its discarded ones do not count up from {entry['seed_start']}."
