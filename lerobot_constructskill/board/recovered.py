"""Where failed episodes of an entry were lost: a row for each, in a file beside the board's entries."""

import json
from collections.abc import Iterable
from dataclasses import asdict, dataclass, field
from enum import StrEnum
from pathlib import Path
from typing import NamedTuple

import pyarrow as pa
import pyarrow.parquet as pq

from lerobot_constructskill.artifacts.code import code_of
from lerobot_constructskill.artifacts.folders import replaced
from lerobot_constructskill.artifacts.tables import VERSIONS, Parquet
from lerobot_constructskill.envs.recording import deciding

RECOVERED = "recovered"
"""Folder of a board: a file for each entry."""

VERSION = 1
"""Of the search and of the names of causes; another one makes the tables anew."""

FAILED = 0
"""In `Recovery.took`: the expert did not place."""

STRIDES = 10
"""Parts of an episode, at whose beginnings the search tries from the back."""

PATIENCE = 40
"""Steps, 2 s, for which advice is hopeless or nothing moves before the expert gives up: an object may fall or roll."""


class Lost(StrEnum):
    """What was lost, as a page says it."""

    NEVER_GRASPED = "never grasped"
    HAND = "hand out of reach"
    PUSHED = "pushed away"
    TIPPED = "tipped"
    OFF_CENTRE = "grasped off centre"
    DROPPED = "dropped"
    EARLY = "released too early"
    BESIDE = "carried beside"
    JAMMED = "jammed"
    TIME = "time alone"
    UNKNOWN = "held to no avail"
    UNSEEN = "ends otherwise here"


MEANING = {
    Lost.NEVER_GRASPED: "the jaws never held the object, and the expert could still fetch it at the end",
    Lost.HAND: "the object is untouched, and the expert cannot bring the bent or stretched arm to it",
    Lost.PUSHED: "nothing held the object, and it was moved",
    Lost.TIPPED: "the object fell over, or turned by more than 10 degrees in the hand",
    Lost.OFF_CENTRE: "held more than 20 mm off the grasp point, it slipped away, or the expert fails with it",
    Lost.DROPPED: "it left closed jaws",
    Lost.EARLY: "the jaws opened on the way, or too high over the goal",
    Lost.BESIDE: "it was let go or pressed down beside the goal, whose outline it overlaps",
    Lost.JAMMED: "it was pressed into the goal askew",
    Lost.TIME: "it is held at the end, and the expert goes on from there",
    Lost.UNKNOWN: "it is held, and the expert fails with it",
    Lost.UNSEEN: "replayed on the machine that searched, the episode does not end as claimed",
}
"""What each of them means."""


@dataclass(frozen=True)
class Recovery:
    """Until when a failed episode could still be saved.

    Args:
        setting, training_seed, evaluation_seed: the episode's.
        steps: how many it had.
        lost: one of `Lost`.
        is_drawn: whether every tenth step was tried too, to check the search.
        is_hopeless: whether the expert gives up one step after the last: the episode is lost to this expert.
        last_step: the last step from which the expert places within the steps that are left; None if there is none.
        last_step_extra: the same if it may go on after the episode's end.
        phase: of the expert's advice in the step `last_step_extra`.
        hand_mm: horizontal distance of hand and object there.
        goal_mm: horizontal distance of object and goal there.
        tried: the steps from which the expert took over.
        took: the steps that it then took, or `FAILED`.
    """

    setting: str
    training_seed: int
    evaluation_seed: int
    steps: int
    lost: str
    is_drawn: bool
    is_hopeless: bool = False
    last_step: int | None = None
    last_step_extra: int | None = None
    phase: str | None = None
    hand_mm: float | None = None
    goal_mm: float | None = None
    tried: list[int] = field(default_factory=list)
    took: list[int] = field(default_factory=list)

    @property
    def key(self) -> tuple[str, int, int]:
        return self.setting, self.training_seed, self.evaluation_seed


TABLE = Parquet("a table of constructskill-recover", Recovery, {list[int]: pa.list_(pa.int32())})


def path_of(root: Path, name: str) -> Path:
    """The file of an entry in a board's folder."""
    return root / RECOVERED / f"{name}.parquet"


def made_with() -> dict[str, str]:
    """Packages, rooms and the make of processor that decide a table, each with its version."""
    return deciding() | code_of("lerobot_constructskill.demos.expert") | {"recover": str(VERSION)}


def write_recovered(path: Path, submission: str, rows: Iterable[Recovery]) -> None:
    """Write the table of the submission with this hash, whole or not at all; the same rows are the same file."""
    said = {"submission": submission, "made_with": json.dumps(made_with(), sort_keys=True)}
    table = pa.Table.from_pylist([asdict(row) for row in rows], schema=TABLE.schema.with_metadata(said))
    with replaced(path) as partial:
        pq.write_table(table, partial, compression="zstd")


class Recovered(NamedTuple):
    """The table of a submission.

    Args:
        rows: by their keys; empty without a file, or where it is of another submission.
        is_current: whether this code would make them again, on whatever make of processor.
    """

    rows: dict[tuple[str, int, int], Recovery]
    is_current: bool


def read_recovered(path: Path, submission: str) -> Recovered:
    """The table of the submission with this hash.

    Raises:
        InputError: the file is no such table.
    """
    if not path.exists():
        return Recovered({}, False)
    table = TABLE.read(path)
    said = table.schema.metadata or {}
    if said.get(b"submission") != submission.encode():
        return Recovered({}, False)
    there = VERSIONS.parse(said.get(b"made_with", b"{}").decode(), f"made_with in '{path}'")
    is_current = all(there.get(name) == own for name, own in made_with().items() if name != "processor")
    return Recovered({row.key: row for row in (Recovery(**row) for row in table.to_pylist())}, is_current)
