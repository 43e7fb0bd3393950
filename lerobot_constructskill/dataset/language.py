"""Checks that LeRobot's language columns say what the phases of the demonstrations say, in every frame."""

from collections.abc import Iterator
from typing import Any

import numpy as np
import pyarrow as pa

from lerobot_constructskill.dataset.dataset import DataSet
from lerobot_constructskill.demos.columns import EVENTS, PERSISTENT
from lerobot_constructskill.demos.expert import Phase
from lerobot_constructskill.demos.language import READ, said_of
from lerobot_constructskill.errors import plural


def check_language(data: DataSet) -> Iterator[str]:
    """Compare the annotations of a set that was made with them with what would be written."""
    if not data.config.annotate:
        return
    if {*data.column("phase")} - {*Phase} or not np.isfinite(data.column("sim.placement")).all():
        yield f"{PERSISTENT} cannot be compared: phase or sim.placement has a value that no expert gives."
        return
    wanted = said_of(pa.table({name: data.column(name) for name in READ}), data.task_of)
    wrong = sum(not _is_said(*both) for both in zip(data.rows[PERSISTENT], wanted, strict=True))
    events = sum(not (isinstance(rows, np.ndarray) and len(rows) == 0) for rows in data.rows[EVENTS])
    if wrong:
        yield f"{PERSISTENT} is not what the phases say in {plural(wrong, 'frame')}."
    if events:
        yield f"{EVENTS} is not empty in {plural(events, 'frame')}."


def _is_said(found: Any, wanted: list[dict[str, Any]]) -> bool:
    """Whether what a frame holds, which anybody may have written, are the rows of its episode."""
    return isinstance(found, np.ndarray) and len(found) == len(wanted) and all(map(_is_row, found, wanted))


def _is_row(found: Any, wanted: dict[str, Any]) -> bool:
    return isinstance(found, dict) and found == wanted | {"timestamp": np.float32(wanted["timestamp"])}
