"""Makes LeRobot hold out every eighth demonstration, by the order of episodes and a share at their end."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import pyarrow as pa

from lerobot_constructskill.contract import TASK_NAME, held_out
from lerobot_constructskill.dataset.dataset import read_info
from lerobot_constructskill.errors import InputError
from lerobot_constructskill.files import read_parquet

SCHEMA = pa.schema([("episode_index", pa.int64()), ("length", pa.int64()), ("tasks", pa.list_(pa.string()))])
"""The columns that are read of LeRobot's table of episodes."""


@dataclass(frozen=True)
class Split:
    """The `dataset.episodes` and `dataset.eval_split` by which LeRobot holds out what the contract does.

    Args:
        episodes: every episode of the set, the held-out ones last.
        n_held_out: how many are held out.
        eval_split: share of each task's episodes that LeRobot takes from their end, rounded up; 0 holds out none.
        frames: frames of the episodes that are trained on.
    """

    episodes: list[int]
    n_held_out: int
    eval_split: float
    frames: int


def split_of(root: Path) -> Split:
    """The split of the data set in a folder.

    Raises:
        MissingError: there is no data set.
        InputError: its episodes cannot be read, or LeRobot cannot split them as the contract does.
    """
    read_info(root)
    files = sorted(root.glob("meta/episodes/*/*.parquet"))
    tables = [_read(file) for file in files]
    rows = pa.concat_tables(tables).sort_by("episode_index").to_pylist() if tables else []
    if not rows:
        raise InputError(f"The data set in {root} has no episodes.")
    names = [row[TASK_NAME] for row in rows] if all(TASK_NAME in row for row in rows) else None
    return split([row["length"] for row in rows], [next(iter(row["tasks"]), "") for row in rows], names)


def _read(file: Path) -> pa.Table:
    """The columns of `SCHEMA` of a file of episodes, and the names of their tasks in a set of several."""
    table = read_parquet(file)
    named = [pa.field(TASK_NAME, pa.string())] if TASK_NAME in table.column_names else []
    schema = pa.schema([*SCHEMA, *named])
    if absent := [name for name in schema.names if name not in table.column_names]:
        raise InputError(f"'{file}' has no column {absent[0]}.")
    table = table.select(schema.names)
    if not table.schema.equals(schema) or any(column.null_count for column in table.columns):
        raise InputError(f"'{file}' must have an index, a length and tasks in every row.")
    return table


def split(lengths: Sequence[int], tasks: Sequence[str], names: Sequence[str] | None = None) -> Split:
    """The split of episodes with these lengths, in frames, and these instructions, LeRobot's tasks.

    In a set of several tasks `names` are those of the episodes' tasks, and every eighth of each of them is held out.

    LeRobot takes ceil(n * eval_split) of the n episodes of each task. That is k, as many as the contract holds out,
    where eval_split is above (k - 1) / n and at most k / n; the middle of what is right for all tasks is taken.

    Raises:
        InputError: there is nothing that is right for all tasks.
    """
    out = set(held_out(names or len(lengths)))
    frames = sum(length for episode, length in enumerate(lengths) if episode not in out)
    places = {task: [episode for episode, one in enumerate(tasks) if one == task] for task in dict.fromkeys(tasks)}
    counts = [(len(out.intersection(own)), len(own)) for own in places.values()]  # held out, and all
    low, high = max((k - 1) / n for k, n in counts), min(k / n for k, n in counts)
    if out and low >= high:
        told = ", ".join(f"{k} of {n}" for k, n in counts)
        raise InputError(
            f"LeRobot holds out the same share of each task, but every eighth demonstration of this set is {told} of "
            "its tasks: train on a set of each task, or on one with equally many of each, in blocks of eight."
        )
    last = sorted(range(len(lengths)), key=out.__contains__)  # stable: both parts stay in order
    return Split(last, len(out), (low + high) / 2 if out else 0.0, frames)
