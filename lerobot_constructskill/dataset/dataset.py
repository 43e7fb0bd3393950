"""Reads a finished data set as plain tables from its files, without LeRobot, whose work the tables serve to check."""

import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Annotated, Any, NotRequired, TypedDict

import numpy as np
import pandas as pd

from lerobot_constructskill.bounds import Count, Pattern, Seed, Word, check_fields
from lerobot_constructskill.contract import FPS, Task
from lerobot_constructskill.demos.columns import (
    JOINT_COLUMNS,
    LANGUAGE,
    PLACEMENT_COLUMNS,
    SIDECAR,
    as_made,
    dagger_features,
    demonstration_features,
)
from lerobot_constructskill.demos.settings import GenerateConfig
from lerobot_constructskill.errors import InputError, MissingError, plural
from lerobot_constructskill.files import Json, read_parquet
from lerobot_constructskill.lerobot_internals import DATA_SET, INFO
from lerobot_constructskill.parsing import decode

STATISTICS = Json("statistics of columns", dict[str, dict[str, Any]])

EPISODE_COLUMNS = "episode_index", "length", "dataset_from_index", "dataset_to_index"
VIDEO_COLUMNS = "chunk_index", "file_index", "from_timestamp", "to_timestamp"
"""Columns of LeRobot's episode tables about every episode, and about its part of every video."""


LATE_S = 1e-4
"""Seconds by which a frame may be late: LeRobot reads none that is off by more."""

PLACE = re.compile(r"(?!/)([\w./-]|\{(video_key|chunk_index(:0?\dd)?|file_index(:0?\dd)?)\})+")
"""The places of videos that LeRobot's `video_path` may name: all are inside the data set."""

NUMBERS = {"float32": "f", "float64": "f", "int64": "i", "int32": "i", "bool": "b"}
"""A column's `dtype` to NumPy's kind; a missing value turns a column of whole numbers into floats."""


Version = Annotated[
    str,
    Pattern(
        r"(?:[\w.+!-]{1,64}, )?source [0-9a-f]{12}(?:, edited: [\w./, -]{1,999})?|[\w.+!-]{1,64}",
        "a version",
    ),
]
"""The version of a package, or what `artifacts/code.py` says of one whose source is hashed."""


class OneRound(TypedDict):
    """A round of DAgger, in one task: what is read of it, beside other fields."""

    round: Count
    seed_start: Seed
    episodes: Count
    placed: int
    frames: int
    by_expert: int
    discarded_seeds: list[Seed]
    beta: float
    policy_sha256: str | None
    checkpoint: str
    task: NotRequired[str]


class Rounds(TypedDict):
    """How DAgger's rounds were made: what is read of it, beside other fields."""

    demonstrations: int
    rounds: list[OneRound]


class Tried(TypedDict):
    """The attempts at one of several tasks."""

    attempts: Count
    discarded_seeds: list[Seed]


class Provenance(TypedDict):
    """How a data set was made: what is read of `meta/constructskill.json`, beside other fields."""

    generator: dict[str, Any]
    attempts: Count
    discarded_seeds: list[Seed]
    versions: dict[Word, Version]
    noise_covariance: list[list[float]]
    sha256: dict[str, str]
    tasks: NotRequired[dict[str, Tried]]
    dagger: NotRequired[Rounds]


ORIGIN = Json("the record of how a data set was made", Provenance)


def check_provenance_fields(facts: Provenance) -> None:
    """Refuse a record whose fields are out of their bounds.

    Raises:
        InputError: the message names the field.
    """
    check_fields(Provenance, facts, f"{SIDECAR}: ")
    for name, tried in facts.get("tasks", {}).items():
        check_fields(Tried, tried, f"{SIDECAR}: tasks.{name[:60]!a}.")


@dataclass(frozen=True)
class TaskBlock:
    """The episodes of one task.

    Args:
        task: its row.
        episodes: their indices, in order; those of DAgger's rounds are not beside the demonstrations.
        attempts: how many were made.
        discarded_seeds: those of the attempts that failed.
    """

    task: Task
    episodes: Sequence[int]
    attempts: int
    discarded_seeds: list[int]


@dataclass(frozen=True)
class DataSet:
    """What lies under `root`.

    Args:
        root: the data set's folder.
        info: meta/info.json.
        stats: meta/stats.json.
        facts: how it was made, meta/constructskill.json.
        rows: one row per frame, in the order of the files.
        episodes: one row per episode.
        tasks: the instruction of each task index.
    """

    root: Path
    info: dict[str, Any]
    stats: dict[str, dict[str, Any]]
    facts: Provenance
    rows: pd.DataFrame
    episodes: pd.DataFrame
    tasks: list[str]
    _columns: dict[str, np.ndarray] = field(init=False, repr=False, compare=False, default_factory=dict)

    def column(self, name: str) -> np.ndarray:
        """A column as (N, ...) array, which cannot be written to; (N,) where a frame holds one value.

        It is read and checked once: checks ask for columns episode by episode.

        Raises:
            InputError: the frames have no such column, or its values are not of the shape that info.json tells.
        """
        if name not in self._columns:
            self._columns[name] = self._read_column(name)
        return self._columns[name]

    def _read_column(self, name: str) -> np.ndarray:
        if name not in self.rows:
            raise InputError(f"data/ has no column {name}.")
        if name not in self.info["features"]:
            raise InputError(f"{INFO} has no '{name}'.")
        values, feature = self.rows[name], self.info["features"][name]
        wanted, kind = tuple(feature["shape"]), feature["dtype"]
        wrong = {np.shape(value) or (1,) for value in values} - {wanted}
        if wrong:
            raise InputError(f"{name} has values of shape {wrong.pop()}, not {wanted} as info.json says.")
        column = np.stack(values) if len(np.shape(values.iloc[0])) else values.to_numpy()
        if kind in NUMBERS and column.dtype.kind not in NUMBERS[kind]:
            raise InputError(f"{name} has values that are no {kind}, as info.json says, or lacks some.")
        column = column.view()
        column.setflags(write=False)
        return column

    @cached_property
    def config(self) -> GenerateConfig:
        """The settings it was generated with."""
        return decode(GenerateConfig, self.facts["generator"])

    @cached_property
    def blocks(self) -> list[TaskBlock]:
        """Its tasks in their order, as the provenance tells them; of the only task all episodes are.

        Raises:
            InputError: the provenance does not say what was attempted of one of several tasks.
        """
        rows, told = self.config.rows, self.facts
        if len(rows) == 1:
            return [TaskBlock(rows[0], range(len(self.episodes)), told["attempts"], told["discarded_seeds"])]
        if [*told.get("tasks", {})] != [row.name for row in rows]:
            raise InputError(f"{SIDECAR} does not say in tasks what was attempted of each of {self.config.task}.")
        return [
            TaskBlock(
                row,
                [episode for episode, name in enumerate(self.task_names) if name == row.name],
                tried["attempts"],
                tried["discarded_seeds"],
            )
            for row, tried in zip(rows, told["tasks"].values(), strict=True)
        ]

    @cached_property
    def task_names(self) -> list[str]:
        """The name of each episode's task, as the provenance tells it: of demonstrations, then of DAgger's rounds.

        Raises:
            InputError: the provenance does not say what was driven in which of several tasks.
        """
        if len(self.config.rows) == 1:
            return [self.config.rows[0].name] * len(self.episodes)
        names = [row.name for row in self.config.rows for _ in range(self.config.episodes)]
        for driven in self.facts["dagger"]["rounds"] if "dagger" in self.facts else ():
            match driven:
                case {"task": str(name), "episodes": int(tried), "discarded_seeds": list(gone)}:
                    # A file may say that there are more than fit in any memory.
                    names += [name] * min(tried - len(gone), len(self.episodes))
                case _:
                    raise InputError(
                        f"{SIDECAR} does not say in dagger what was driven in each of {self.config.task}."
                    )
        return names

    def task_of(self, episode: int) -> Task:
        """The row of an episode's task, the last one's for an episode more than there should be."""
        tasks, names = {block.task.name: block.task for block in self.blocks}, self.task_names
        return tasks.get(names[episode] if episode < len(names) else "", self.blocks[-1].task)

    @cached_property
    def columns(self) -> dict[str, dict[str, Any]]:
        """The columns that the data set should have, with DAgger's if a learner drove.

        A set without any column of joints, or of placements, was made before these were recorded.
        """
        made = dagger_features if "dagger" in self.facts else demonstration_features
        features = made(self.config.rows[0], self.config.seen, self.config.state)
        return as_made(features, self.has_joints, self.has_placements) | (LANGUAGE if self.config.annotate else {})

    @property
    def has_joints(self) -> bool:
        return self._has_any(JOINT_COLUMNS)

    @property
    def has_placements(self) -> bool:
        return self._has_any(PLACEMENT_COLUMNS)

    def _has_any(self, names: tuple[str, ...]) -> bool:
        return any(name in self.info["features"] or name in self.rows for name in names)

    @cached_property
    def rounds(self) -> np.ndarray:
        """The round of DAgger in which each frame came about, (N,); 0 for demonstrations."""
        return self.column("dagger.round") if "dagger" in self.facts else np.zeros(len(self.rows), dtype=np.int64)

    @property
    def cameras(self) -> list[str]:
        return [name for name, feature in self.info["features"].items() if feature["dtype"] == "video"]

    def video(self, camera: str, episode: pd.Series) -> Path:
        if not self.info.get("video_path"):
            raise InputError(f"{INFO} does not say where its videos are, video_path.")
        indices = {name: int(episode[f"videos/{camera}/{name}"]) for name in ("chunk_index", "file_index")}
        return self.root / self.info["video_path"].format(video_key=camera, **indices)

    def spans(self) -> list[slice]:
        """Where each episode lies in the rows, as `episode_index` says."""
        index = self.column("episode_index")
        starts = np.flatnonzero(np.diff(index, prepend=index[0] - 1))
        return [slice(int(a), int(b)) for a, b in zip(starts, [*starts[1:], len(index)], strict=True)]


def open_dataset(root: Path) -> DataSet:
    """Read everything but the videos.

    Raises:
        FileNotFoundError: there is no data set at `root`.
        ValueError: a file that cannot be read, or that lacks what every data set has; the message names it.
    """
    info = read_info(root)
    tasks = _tables(root, "meta/tasks.parquet").reset_index()
    if "task_index" not in tasks:
        raise InputError("meta/tasks.parquet has no column task_index.")
    data = DataSet(
        root=root,
        info=info,
        stats=STATISTICS.read(root / "meta/stats.json"),
        facts=read_provenance(root),
        rows=_tables(root, "data/*/*.parquet"),
        episodes=_tables(root, "meta/episodes/*/*.parquet"),
        tasks=tasks.sort_values("task_index").iloc[:, 0].tolist(),
    )
    if data.rows.empty:
        raise InputError("data/ holds no frames.")
    of_videos = [f"videos/{camera}/{name}" for camera in data.cameras for name in VIDEO_COLUMNS]
    for name in (*EPISODE_COLUMNS, *of_videos):
        values = data.episodes.get(name)
        if values is None or values.dtype.kind not in "if" or not np.isfinite(values).all():
            raise InputError(f"meta/episodes/ must have {name}, a number in every row.")
    return data


def read_info(root: Path) -> dict[str, Any]:
    """LeRobot's description of a data set.

    Raises:
        MissingError: meta/info.json, which every data set has, is missing.
        InputError: it is something else, or its videos would lie elsewhere.
    """
    if not (root / INFO).is_file():
        raise MissingError(f"There is no data set in {root}: {INFO} is missing.")
    info = DATA_SET.read(root / INFO)
    template = info.get("video_path")
    if template is not None and not (PLACE.fullmatch(template) and ".." not in template):
        raise InputError(f"video_path in '{root / INFO}' is no place in the data set: {template[:100]!a}.")
    return info


def read_provenance(root: Path) -> Provenance:
    """How a data set was made.

    Raises:
        MissingError: nothing says so.
        InputError: the file cannot be read.
    """
    if not (root / SIDECAR).is_file():
        raise MissingError(
            f"{root} has no {SIDECAR}, which says how it was made: only constructskill-generate writes it, and "
            "lerobot-edit-dataset removes it when it deletes, splits or merges."
        )
    return ORIGIN.read(root / SIDECAR)


def _tables(root: Path, pattern: str) -> pd.DataFrame:
    paths = sorted(root.glob(pattern))
    if not paths:
        raise InputError(f"{pattern} cannot be read (there is no such file).")
    return pd.concat([read_parquet(path).to_pandas() for path in paths], ignore_index=len(paths) > 1)


def video_complaints(path: Path, name: Path, expected: int, fps: float) -> Iterator[str]:
    """Yield what is wrong with the time stamps of a video: it cannot be read, lacks frames or has another rate.

    Args:
        name: what to call it.
        expected: how many frames it has, at least.
        fps: how many frames a second.
    """
    import av

    if not path.is_file():
        yield f"{name} is missing."
        return
    try:
        with av.open(str(path)) as video:
            stream = video.streams.video[0]
            stamps = sorted(packet.pts * stream.time_base for packet in video.demux(stream) if packet.pts is not None)
    except (av.FFmpegError, IndexError) as error:
        yield f"{name} cannot be read ({error})."
        return
    times = np.array(stamps, dtype=float)
    if len(times) < expected:
        yield f"{name} has {plural(len(times), 'frame')}, but its episodes have {expected} rows."
    elif np.abs(times * fps - np.arange(len(times))).max(initial=0) > LATE_S * FPS:
        yield f"{name} has not the {fps} frames a second (fps) that meta/info.json says."
