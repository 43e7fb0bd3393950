"""How long the stages of a study took, for plans and reports: each adds a line to a file. No torch, no simulator."""

import json
import time
from collections import defaultdict
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, NotRequired, TypedDict

from annotated_types import Ge, Lt

from lerobot_constructskill.files import Json, read_bytes

TIMINGS = "timings.jsonl"
"""File in a study's folder."""

STAGES = ("demonstrations", "data", "training", "evaluation", "validation")
"""In the order of a study: demonstrations; what policies learn from, made of them (features); checkpoints, with what
else is made for them, such as rounds of DAgger; episodes; held-out errors."""


class _Entry(TypedDict):
    arm: str
    stage: str
    runs: Annotated[int, Ge(1)]
    nodes: NotRequired[Annotated[int, Ge(1)]]
    seconds: Annotated[float, Ge(0), Lt(1e9)]


ENTRY = Json("the time of a stage", _Entry)


OF_RUNS = STAGES[2:]
"""Stages that are made for each run; the others for each set that runs share."""


@dataclass(frozen=True)
class Took:
    """How long a stage took, over all of a study.

    Args:
        stage: one of `STAGES`.
        runs: runs that it was made for.
        seconds: on the wall.
    """

    stage: str
    runs: int
    seconds: float


@contextmanager
def timed(root: Path, arm: str, stage: str, runs: int, nodes: int = 1) -> Iterator[None]:
    """Note how long the block takes; work of a killed process is not counted.

    Args:
        arm: setting/variant of the runs that it is for.
        stage: one of `STAGES`.
        runs: how many.
        nodes: how many data sets or features they share.
    """
    start = time.monotonic()
    yield
    entry = {"arm": arm, "stage": stage, "runs": runs, "seconds": round(time.monotonic() - start, 1)}
    entry |= {"nodes": nodes} if nodes > 1 else {}
    with (root / TIMINGS).open("a", encoding="utf-8") as file:  # a short write, which others do not tear
        file.write(json.dumps(entry) + "\n")


def time_by_stage(root: Path) -> list[Took]:
    """What each stage of a study took in all, in the order of `STAGES`."""
    runs: dict[str, int] = defaultdict(int)
    seconds: dict[str, float] = defaultdict(float)
    for entry in entries(root):
        runs[entry["stage"]] += entry["runs"]
        seconds[entry["stage"]] += entry["seconds"]
    return [Took(stage, runs[stage], seconds[stage]) for stage in STAGES if stage in runs]


def seconds_of_one(entry: _Entry) -> float:
    """How long a stage took for one run, or for one of the sets that runs share."""
    return entry["seconds"] / (entry["runs"] if entry["stage"] in OF_RUNS else entry.get("nodes", 1))


def entries(root: Path) -> Iterator[_Entry]:
    """The lines of a study's file, in their order."""
    file = root / TIMINGS
    for line in read_bytes(file).splitlines() if file.exists() else []:
        with suppress(ValueError):  # a line that a full disk or a power cut tore, or of another version
            yield ENTRY.parse(line.decode(), f"A line of '{file}'")
