"""Where a study's time went: every piece of work adds a line to a file. No torch, no simulator."""

import json
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

TIMINGS = "timings.jsonl"


@contextmanager
def timed(root: Path, stage: str) -> Iterator[None]:
    """Add the seconds that the block takes to `stage`; work of a killed process is not counted."""
    start = time.monotonic()
    yield
    line = json.dumps({"stage": stage, "seconds": round(time.monotonic() - start, 1)})
    with (root / TIMINGS).open("a") as file:  # one short write: processes that append at once do not mix
        file.write(line + "\n")


def seconds_by_stage(root: Path) -> dict[str, float]:
    """Sum the lines of a study's folder; processes that ran at once add up to more than passed on the clock."""
    total: dict[str, float] = {}
    file = root / TIMINGS
    for line in file.read_text().splitlines() if file.exists() else []:
        try:
            entry = json.loads(line)
        except ValueError:  # a line that a full disk or a power cut tore
            continue
        total[entry["stage"]] = total.get(entry["stage"], 0) + entry["seconds"]
    return total
