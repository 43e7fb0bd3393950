"""How long runs took, for estimates: each piece of work adds a line to a file. No torch, no simulator."""

import json
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Annotated, TypedDict

from annotated_types import Ge, Lt

from lerobot_constructskill.files import Json, read_bytes

TIMINGS = "timings.jsonl"
"""File in a study's folder."""


class _Entry(TypedDict):
    arm: str
    seconds: Annotated[float, Ge(0), Lt(1e9)]


ENTRY = Json("the time of a run", _Entry)


@contextmanager
def timed(root: Path, arm: str, runs: int) -> Iterator[None]:
    """Note how long the block takes; work of a killed process is not counted.

    Args:
        arm: setting/variant of the runs that are made.
        runs: how many.
    """
    start = time.monotonic()
    yield
    entry = {"arm": arm, "seconds": round((time.monotonic() - start) / runs, 1)}
    with (root / TIMINGS).open("a", encoding="utf-8") as file:  # a short write, which others do not tear
        file.write(json.dumps(entry) + "\n")


def seconds_per_run(root: Path) -> dict[str, float]:
    """What a run of each arm took, trained and evaluated, the last time that some were made."""
    file, took = root / TIMINGS, {}
    for line in read_bytes(file).splitlines() if file.exists() else []:
        with suppress(ValueError):  # a line that a full disk or a power cut tore, or of another version
            entry = ENTRY.parse(line.decode(), f"A line of '{file}'")
            took[entry["arm"]] = entry["seconds"]
    return took
