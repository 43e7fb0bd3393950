"""Shards into one LeRobotDataset by LeRobot's own aggregation, in the order of their seeds, the same bytes always."""

import json
from pathlib import Path

import numpy as np
import pandas as pd

from lerobot_constructskill.contract import get_task
from lerobot_constructskill.demos.columns import SIDECAR
from lerobot_constructskill.demos.hashes import file_hashes
from lerobot_constructskill.demos.modality import MODALITY, modality
from lerobot_constructskill.demos.settings import GenerateConfig, package_versions, provenance
from lerobot_constructskill.demos.shards import EPISODE, Attempt


def merge(config: GenerateConfig, attempts: list[Attempt], shards: Path, folder: Path) -> None:
    """Write the data set of `attempts`, which are in the order of their seeds, to `folder`.

    Raises:
        ValueError: the attempts were drawn in different ways, on machines that are not alike.
    """
    from lerobot.datasets.aggregate import aggregate_datasets

    if len({attempt.light_robot for attempt in attempts}) > 1:
        raise ValueError(
            "Some attempts drew the light robot and some the full one, on machines with and without a GPU: "
            "set --light_robot and generate anew."
        )
    roots = [shards / str(attempt.seed) / EPISODE for attempt in attempts if attempt.success]
    aggregate_datasets([config.repo_id] * len(roots), config.repo_id, roots, folder)
    _write_statistics(folder)
    task = get_task(config.task)
    (folder / MODALITY).write_text(json.dumps(modality(task, config.obs_type), indent=2) + "\n")
    facts = {
        "generator": provenance(config) | {"light_robot": attempts[0].light_robot},
        "noise_covariance": (config.noise.root @ config.noise.root).tolist(),
        "attempts": len(attempts),
        "discarded_seeds": [attempt.seed for attempt in attempts if not attempt.success],
        "versions": package_versions(),
        "sha256": file_hashes(folder),
    }
    (folder / SIDECAR).write_text(json.dumps(facts, indent=2) + "\n")


def _write_statistics(folder: Path) -> None:
    """Put the statistics of all frames in place of aggregated ones, and their names in order.

    LeRobot averages the quantiles of episodes, which are not the data set's, and lists columns in the order of a set.
    """
    from lerobot.datasets.io_utils import load_stats, write_stats

    statistics = (load_stats(folder) or {}) | frame_statistics(folder)
    write_stats({name: statistics[name] for name in sorted(statistics)}, folder)


def frame_statistics(folder: Path) -> dict[str, dict[str, np.ndarray]]:
    """Statistics over all frames of every numeric column of the data set in `folder`, by LeRobot's own function."""
    from lerobot.datasets.compute_stats import compute_episode_stats
    from lerobot.datasets.io_utils import load_info

    features = load_info(folder).features
    statistics = {}
    for name, feature in features.items():
        if feature["dtype"] in ("string", "image", "video"):
            continue
        paths = sorted((folder / "data").rglob("*.parquet"))
        column = np.concatenate([np.stack(pd.read_parquet(path, columns=[name])[name]) for path in paths])
        statistics |= compute_episode_stats({name: column}, features)
    return statistics
