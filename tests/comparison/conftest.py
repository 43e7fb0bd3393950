"""Sides of comparisons on disk: a study's folder, recordings and checkpoints."""

import json
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest
import yaml
from random_features import config, tiny_weights  # noqa: F401

from lerobot_constructskill.envs.recording import RECORDINGS, Episode, deciding, write_recordings
from lerobot_constructskill.study.rows import NOT_RUN, VARIANT, Row, write_rows

ENV = {"task": "block_to_bin", "episode_length": 5, "obs_type": "pixels_agent_pos"}
STARTS = range(1000, 1010)


@pytest.fixture
def study(tmp_path):
    """Write a study's folder; return what names its variant.

    Each training seed placed from so many starts, the first ones; it failed where that is None, was not run where -1.
    `draws` are fields of the study's file.
    """

    def write(
        placed: Sequence[int | None],
        name="study",
        env: dict = ENV,
        starts: Sequence = STARTS,
        draws: dict | None = None,
        data: str | None = None,
    ) -> str:
        draws = draws or {}
        common = {"run": None, "setting": "block", "variant": "ours", "role": VARIANT, "episodes": len(starts)}
        common["dataset_sha256"] = data
        common["versions"] = json.dumps({"lerobot": "0.6.1", "torch": name, "processor": "a CPU"})
        rows = []
        for seed, count in enumerate(placed):
            if count is None or count < 0:
                fault = {"error_kind": "fault" if count is None else NOT_RUN, "error": "it fell"}
                rows.append(Row(training_seed=seed, evaluation_seed=starts[0], episode=0, **fault, **common))
                continue
            moved = seed // draws.get("seeds_a_draw", 1) * len(starts) if draws.get("starts") == "own" else 0
            for i, start in enumerate(starts):
                rows.append(
                    Row(training_seed=seed, evaluation_seed=moved + start, episode=i, placed=i < count, **common)
                )
        folder = tmp_path / name
        folder.mkdir()
        write_rows(rows, folder / "rows.parquet")
        (folder / "study.yaml").write_text(yaml.safe_dump({"settings": {"block": {"env": env}}} | draws))
        return f"{folder}:block/ours"

    return write


@pytest.fixture
def recorded(tmp_path):
    """Write recordings as $CONSTRUCTSKILL_RECORD does, or in one file; return a pattern of the folders."""

    def write(placed: Sequence[int], name: str = "recorded", whole: bool = False, **facts) -> str:
        common = {"versions": json.dumps(deciding())} | ENV | facts
        for seed, count in enumerate(placed):
            folder = tmp_path / name / f"seed_{seed}"
            episodes = [
                Episode(start, placed=i < count, actions=[np.full(4, seed + i, np.float32)], **common)
                for i, start in enumerate(STARTS)
            ]
            if whole:
                write_recordings(episodes, folder / RECORDINGS)
            else:
                [one.write(folder) for one in episodes]
        return str(tmp_path / name / "seed_*")

    return write


@pytest.fixture
def checkpoints(tmp_path):
    """Folders that look like checkpoints; return a pattern of them."""

    def write(n: int, name: str = "train", inner: str = "checkpoints/last/pretrained_model") -> str:
        for seed in range(n):
            folder: Path = tmp_path / name / f"seed_{seed}" / inner
            folder.mkdir(parents=True)
            (folder / "config.json").write_text("{}")
        return str(tmp_path / name / "seed_*")

    return write
