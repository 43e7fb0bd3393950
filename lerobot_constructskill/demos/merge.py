"""Merges shards into one LeRobotDataset by LeRobot's own aggregation, in the order of seeds, with the same bytes."""

import json
import tempfile
from itertools import batched
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from lerobot_constructskill.artifacts.digests import files_below
from lerobot_constructskill.artifacts.disk import room_for
from lerobot_constructskill.contract import TASK_NAME
from lerobot_constructskill.demos.columns import SIDECAR
from lerobot_constructskill.demos.language import annotate
from lerobot_constructskill.demos.metadata import file_hashes, write_meanings
from lerobot_constructskill.demos.settings import GenerateConfig, frame_versions, generator_facts
from lerobot_constructskill.demos.shards import Block
from lerobot_constructskill.errors import InputError
from lerobot_constructskill.files import read_parquet
from lerobot_constructskill.progress import quiet

if TYPE_CHECKING:
    from datasets import Dataset

GROUP = 32
"""Data sets that are aggregated at a time."""


def merge(config: GenerateConfig, blocks: list[Block], folder: Path) -> None:
    """Write the data set of `blocks`, whose attempts are in the order of their seeds, to `folder`.

    Raises:
        ValueError: the attempts were drawn in different ways, on machines that are not alike.
    """
    attempts = [attempt for block in blocks for attempt in block.attempts]
    if len({attempt.light_robot for attempt in attempts}) > 1:
        raise InputError(
            "Some attempts drew the light robot and some the full one, on machines with and without a GPU: "
            "set --light_robot and generate all of them again."
        )
    if len(backends := {attempt.backend for attempt in attempts}) > 1:
        raise InputError(
            f"Some attempts were made by {' and some by '.join(sorted(backends))}: remove {blocks[0].shards.parent} "
            "and generate all of them on machines of one kind."
        )
    roots = [root for block in blocks for root in block.demonstrations]
    # The disk's room is measured before the scratch folder is gone.
    with tempfile.TemporaryDirectory(dir=blocks[0].shards) as scratch, room_for(folder), quiet():
        aggregate(config.repo_id, roots, folder, Path(scratch))
    write_statistics(folder)
    if config.annotate:
        annotate(folder, [row for row, block in zip(config.rows, blocks, strict=True) for _ in block.demonstrations])
    write_meanings(folder, config.rows, config.seen, config.state)
    of_tasks = {}
    if len(blocks) > 1:
        name_tasks(folder, [block.config.task for block in blocks for _ in block.demonstrations])
        of_tasks["tasks"] = {
            block.config.task: {"attempts": len(block.attempts), "discarded_seeds": block.discarded}
            for block in blocks
        }
    facts = {
        "generator": generator_facts(config) | {"light_robot": attempts[0].light_robot},
        "noise_covariance": (config.noise.root @ config.noise.root).tolist(),
        "attempts": len(attempts),
        "discarded_seeds": [seed for block in blocks for seed in block.discarded],
        **of_tasks,
        "versions": frame_versions(config),
        "sha256": file_hashes(folder),
    }
    (folder / SIDECAR).write_text(json.dumps(facts, indent=2) + "\n", encoding="utf-8")


def name_tasks(folder: Path, names: list[str]) -> None:
    """Write the name of each episode's task into LeRobot's table of episodes."""
    import pyarrow as pa
    import pyarrow.parquet as pq

    for path in (folder / "meta" / "episodes").glob("*/*.parquet"):
        table = read_parquet(path)
        own = [names[episode] for episode in table["episode_index"].to_pylist()]
        pq.write_table(table.append_column(TASK_NAME, pa.array(own)), path)


def aggregate(repo_id: str, roots: list[Path], folder: Path, scratch: Path) -> None:
    """Aggregate data sets in groups of groups: LeRobot rewrites the growing files for every set that it appends."""
    from lerobot.datasets import aggregate_datasets

    from lerobot_constructskill.lerobot_internals import patched

    with patched("load_episodes", kept_of_episodes):  # of each of them
        while len(roots) > GROUP:
            groups = list(batched(roots, GROUP))
            scratch = scratch / "groups"
            roots = [scratch / str(number) for number in range(len(groups))]
            for group, root in zip(groups, roots, strict=True):
                aggregate_datasets([repo_id] * len(group), repo_id, list(group), root)
        aggregate_datasets([repo_id] * len(roots), repo_id, roots, folder)


def kept_of_episodes(folder: Path) -> "Dataset":
    """The episodes of a data set without their statistics, which LeRobot would read and drop.

    Statistics are nine of ten columns, and the time that `datasets` takes grows with the square of their number.
    Nothing is written to the cache of `datasets`.
    """
    from datasets import Dataset
    from pyarrow.dataset import dataset

    episodes = dataset(sorted(map(str, (folder / "meta" / "episodes").glob("*/*.parquet"))))
    kept = [name for name in episodes.schema.names if not name.startswith("stats/")]
    return Dataset(episodes.to_table(columns=kept).replace_schema_metadata())


def write_statistics(folder: Path) -> None:
    """Replace the aggregated statistics by those of all frames, with columns in the order of their names.

    LeRobot averages the quantiles of episodes, which differ from those of the data set, and its order of columns is
    that of a Python set.
    """
    from lerobot.datasets import write_stats

    from lerobot_constructskill.lerobot_internals import load_stats

    statistics = (load_stats(folder) or {}) | frame_statistics(folder)
    write_stats({name: statistics[name] for name in sorted(statistics)}, folder)


def frame_statistics(folder: Path) -> dict[str, dict[str, np.ndarray]]:
    """Statistics over all frames of every numeric column of the data set in `folder`, by LeRobot's own function.

    It takes the variance as a difference of squares: in float32 an angle near pi that moves by 4 mrad has none.
    """
    from lerobot_constructskill.lerobot_internals import compute_episode_stats, load_info

    features = load_info(folder).features
    statistics = {}
    for name, feature in features.items():
        if feature["dtype"] in ("string", "image", "video", "language"):
            continue
        paths = (path for path in files_below(folder, "data") if path.suffix == ".parquet")
        column = np.concatenate([np.stack(read_parquet(path, [name]).to_pandas()[name]) for path in paths])
        statistics |= compute_episode_stats({name: column.astype(np.float64)}, features)
    return statistics
