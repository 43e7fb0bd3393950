"""LeRobot's language columns, as the expert knows them to the frame: its subtasks, and other words for the task.

Elsewhere a vision-language model fills these columns (`lerobot-annotate`). A row of `language_persistent` holds from
its time stamp on, until the next row of its style; every frame of an episode has all of the episode's rows.
"""

import json
import re
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa

from lerobot_constructskill.artifacts.digests import files_below
from lerobot_constructskill.contract import Task
from lerobot_constructskill.demos.columns import EVENTS, LANGUAGE, PERSISTENT
from lerobot_constructskill.demos.expert import Phase
from lerobot_constructskill.files import read_parquet
from lerobot_constructskill.lerobot_internals import DATA_SET, INFO
from lerobot_constructskill.plans.plan import read_plan

SUBTASKS = {
    Phase.PREGRASP: "Move the open gripper above the {}.",
    Phase.DESCEND: "Lower the open gripper to the {}.",
    Phase.GRASP: "Close the gripper on the {}.",
    Phase.LIFT: "Lift the {}.",
    Phase.CARRY: "Carry the {} over its place.",
    Phase.RELEASE: "Set the {} down and let go.",
}
"""What each phase is called, of an object."""

OBJECTS = "concrete block|ceiling tile|timber post|brick|block|tile|post|beam"
"""What an instruction may call its object; the first that it names is meant."""

ROW = pa.struct(
    [
        ("role", pa.string()),
        ("content", pa.string()),
        ("style", pa.string()),
        ("timestamp", pa.float32()),
        ("camera", pa.string()),
        ("tool_calls", pa.list_(pa.string())),
    ]
)
"""A row of `language_persistent`; one of `language_events`, of which there are none, has no time stamp."""

EVENT = pa.struct([field for field in ROW if field.name != "timestamp"])


def objects_of(task: Task) -> list[str]:
    """What the object of each of a task's placements is called."""
    if task.plan is None:
        named = re.search(rf"\b({OBJECTS})\b", task.instruction)
        return [named[0] if named else "object"]
    kinds = [element.kind for element in read_plan(task.plan).elements.values()]
    ordinal = [kinds[: number + 1].count(kind) for number, kind in enumerate(kinds)]
    return [f"{kind} {n}" if kinds.count(kind) > 1 else kind for kind, n in zip(kinds, ordinal, strict=True)]


def persistent_rows(task: Task, phases: np.ndarray, placements: np.ndarray, times: np.ndarray) -> list[dict[str, Any]]:
    """What holds in an episode, in the order of time.

    Args:
        phases, placements, times: the columns `phase`, `sim.placement` and `timestamp` of its frames, (T,) each.
    """
    objects, starts = objects_of(task), [0, *(np.flatnonzero(phases[1:] != phases[:-1]) + 1)]
    told = [task.instruction, *next(iter(task.rewordings), ())]
    rows = [_row("user", words, "task_aug", times[0]) for words in told]
    for start, stop in zip(starts, [*starts[1:], len(phases)], strict=True):
        # An object counts as placed while the hand still opens, and the one before may do so until after that.
        number = int(placements[start if phases[start] == Phase.RELEASE else stop - 1])
        words = SUBTASKS[Phase(phases[start])].format(objects[np.clip(number, 0, len(objects) - 1)])
        rows.append(_row("assistant", words, "subtask", times[start]))
    return rows


def _row(role: str, content: str, style: str, time: float) -> dict[str, Any]:
    told = {"role": role, "content": content, "style": style, "timestamp": float(time)}
    return told | {"camera": None, "tool_calls": None}


def annotate(folder: Path, tasks: Sequence[Task]) -> None:
    """Write the language columns into a data set whose episodes are of these tasks."""
    from lerobot_constructskill.lerobot_internals import write_table_one_row_group_per_episode

    for path in (path for path in files_below(folder, "data") if path.suffix == ".parquet"):
        table = read_parquet(path)
        rows = said_of(table, tasks.__getitem__)
        table = table.replace_schema_metadata()  # which would tell `datasets` of the columns before
        table = table.append_column(PERSISTENT, pa.array(rows, pa.list_(ROW)))
        table = table.append_column(EVENTS, pa.array([[]] * len(rows), pa.list_(EVENT)))
        write_table_one_row_group_per_episode(table, path)
    info = DATA_SET.read(folder / INFO)
    text = json.dumps(info | {"features": {**info["features"], **LANGUAGE}}, indent=4, ensure_ascii=False)
    (folder / INFO).write_text(text, encoding="utf-8")


READ = ("episode_index", "phase", "sim.placement", "timestamp")
"""The columns that `said_of` reads."""


def said_of(table: pa.Table, task_of: Callable[[int], Task]) -> list[list[dict[str, Any]]]:
    """What holds in the episode of each frame of a table.

    Args:
        task_of: the task of an episode by its number.
    """
    episodes, *columns = (np.asarray(table[name].to_pylist()).reshape(len(table)) for name in READ)
    frames = {int(episode): np.flatnonzero(episodes == episode) for episode in dict.fromkeys(episodes)}
    said = {
        episode: persistent_rows(task_of(episode), *(column[own] for column in columns))
        for episode, own in frames.items()
    }
    return [said[int(episode)] for episode in episodes]
