"""A finished data set as plain tables, read from its files alone: whoever checks LeRobot's work cannot ask LeRobot."""

import json
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from lerobot_constructskill.demos.columns import SIDECAR
from lerobot_constructskill.demos.settings import GenerateConfig


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
    stats: dict[str, Any]
    facts: dict[str, Any]
    rows: pd.DataFrame
    episodes: pd.DataFrame
    tasks: list[str]

    def column(self, name: str) -> np.ndarray:
        """A column as (N, ...) array; (N,) where a frame holds one value."""
        values = self.rows[name]
        return np.stack(values) if values.dtype == object and len(np.shape(values.iloc[0])) else values.to_numpy()

    @cached_property
    def config(self) -> GenerateConfig:
        """The settings it was generated with."""
        import draccus

        return draccus.decode(GenerateConfig, self.facts["generator"])

    @property
    def cameras(self) -> list[str]:
        return [name for name, feature in self.info["features"].items() if feature["dtype"] == "video"]

    def video(self, camera: str, episode: pd.Series) -> Path:
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
        ValueError: a file that cannot be read; the message names it.
    """
    if not (root / "meta" / "info.json").is_file():
        raise FileNotFoundError(f"There is no data set in {root}: meta/info.json is missing.")
    tasks = _tables(root, "meta/tasks.parquet").reset_index()
    return DataSet(
        root=root,
        info=_json(root, "meta/info.json"),
        stats=_json(root, "meta/stats.json"),
        facts=_json(root, SIDECAR),
        rows=_tables(root, "data/*/*.parquet"),
        episodes=_tables(root, "meta/episodes/*/*.parquet"),
        tasks=tasks.sort_values("task_index").iloc[:, 0].tolist(),
    )


def _json(root: Path, name: str) -> dict[str, Any]:
    try:
        return json.loads((root / name).read_text())
    except (OSError, ValueError) as error:
        raise ValueError(f"{name} cannot be read ({error}).") from None


def _tables(root: Path, pattern: str) -> pd.DataFrame:
    paths = sorted(root.glob(pattern))
    if not paths:
        raise ValueError(f"{pattern} cannot be read (there is no such file).")
    tables = []
    for path in paths:
        try:
            tables.append(pd.read_parquet(path))
        except (OSError, ValueError) as error:
            raise ValueError(f"{path.relative_to(root)} cannot be read ({error}).") from None
    return pd.concat(tables, ignore_index=len(paths) > 1)
