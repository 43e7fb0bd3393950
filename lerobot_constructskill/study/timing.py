"""Where a study's time went: every piece of work adds a line to a file. No torch, no simulator."""

import json
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Annotated, NotRequired, TypedDict

from annotated_types import Ge, Lt

from lerobot_constructskill.files import Json, read_bytes

TIMINGS = "timings.jsonl"

DEMONSTRATIONS, TRAINING, EVALUATION = "demonstrations", "encoding and training", "evaluation"
ROUNDS = "rounds of DAgger"
"""The stages of a study; with rounds, training is part of them."""


class _Entry(TypedDict):
    stage: str
    seconds: Annotated[float, Ge(0), Lt(1e9)]
    arm: NotRequired[str]
    runs: NotRequired[Annotated[int, Ge(1)]]


ENTRY = Json("the time of a piece of work", _Entry)


@contextmanager
def timed(root: Path, stage: str, arm: str | None = None, runs: int = 1) -> Iterator[None]:
    """Add the seconds that the block takes to `stage`; work of a killed process is not counted.

    Args:
        arm: setting/variant whose runs they were spent on, if on one.
        runs: how many of its runs.
    """
    start = time.monotonic()
    yield
    spent = {"stage": stage, "seconds": round(time.monotonic() - start, 1)}
    line = json.dumps(spent | ({"arm": arm, "runs": runs} if arm else {}))
    with (root / TIMINGS).open(
        "a", encoding="utf-8"
    ) as file:  # one short write: processes that append at once do not mix
        file.write(line + "\n")


def seconds_by_stage(root: Path) -> dict[str, float]:
    """Sum the lines of a study's folder; processes that ran at once add up to more than passed on the clock."""
    total: dict[str, float] = {}
    for entry in _entries(root):
        total[entry["stage"]] = total.get(entry["stage"], 0) + entry["seconds"]
    return total


def seconds_per_run(root: Path) -> dict[str, dict[str, float]]:
    """What a run of each arm took by stage, the last time that the arm was at it."""
    took: dict[str, dict[str, float]] = {}
    for entry in _entries(root):
        if "arm" in entry:
            took.setdefault(entry["arm"], {})[entry["stage"]] = entry["seconds"] / entry.get("runs", 1)
    return took


def _entries(root: Path) -> Iterator[_Entry]:
    file = root / TIMINGS
    for line in read_bytes(file).splitlines() if file.exists() else []:
        with suppress(ValueError):  # a line that a full disk or a power cut tore
            yield ENTRY.parse(line.decode(), f"A line of '{file}'")
