"""`constructskill-offline`: errors of any LeRobot policies on held-out demonstrations, a row for each checkpoint."""

import json
from dataclasses import asdict, dataclass
from glob import glob
from pathlib import Path
from typing import Annotated

from lerobot_constructskill.artifacts.digests import data_sha256, file_sha256
from lerobot_constructskill.artifacts.folders import replaced, write_text
from lerobot_constructskill.bounds import BatchSize, Checked, Device, Episodes, NotEmpty, RepoId, Seed, Text
from lerobot_constructskill.errors import MissingError, plural
from lerobot_constructskill.lerobot_internals import TRAIN_CONFIG, TRAINED
from lerobot_constructskill.scripts.console import run
from lerobot_constructskill.training.recipe import FACTS, SAID

Patterns = Annotated[list[Text], NotEmpty()]


@dataclass
class OfflineConfig(Checked):
    """Print and write a table of translation errors in metres, gripper accuracy and chunk consistency."""

    policies: Patterns  # `pretrained_model` folders; patterns such as outputs/fast/train/*/*/last/pretrained_model
    repo_id: RepoId  # the demonstrations
    root: Path | None = None  # their folder; default: LeRobot's cache, or the Hub
    revision: Text | None = None  # tag, branch or commit on the Hub
    episodes: Episodes | None = None  # held-out demonstrations; default: every eighth, refused if trained on
    out: Path = Path("outputs/offline")  # folder for offline.json and offline.parquet
    batch_size: BatchSize = 32  # frames at a time
    seed: Seed = 0  # of policies that sample their actions
    device: Device | None = None  # default: that of the checkpoint
    backbone_precision: Text | None = None  # of frozen_vit, if this machine would emulate the checkpoint's


SHOWN = ("policy", "training_seed", "rmse_m", "mean_m", "gripper_accuracy", "gripper_change_accuracy", "consistency_m")
"""Columns that are printed; the files have all."""

TYPES = {
    "training_seed": "Int64",
    "rmse_rotation_rad": float,
    "gripper_change_accuracy": float,
    "consistency_m": float,
}
"""Types of columns in which a value can be missing."""


def evaluate_offline(config: OfflineConfig) -> str:
    """Evaluate every checkpoint, write the files and return the table.

    Raises:
        FileNotFoundError: there is no such checkpoint or data set.
        ValueError: no such episodes.
    """
    import pandas as pd

    from lerobot_constructskill.dataset.hub import choose_held_out, open_lerobot
    from lerobot_constructskill.progress import Progress

    checkpoints = _find(config.policies)
    dataset = open_lerobot(config.repo_id, config.root, config.revision)
    episodes = choose_held_out(dataset, config.episodes, checkpoints)
    source = {
        "episodes": ",".join(map(str, episodes)),
        "dataset": config.repo_id,
        "dataset_revision": dataset.revision if config.root is None else None,
        "dataset_sha256": data_sha256(dataset.root),
    }
    bar = Progress(checkpoints, "policies", unit="policy")
    rows = [_row(path, dataset, episodes, config) | source for path in bar]
    table = pd.DataFrame(rows).astype(TYPES)
    write_text(config.out / "offline.json", json.dumps(rows, indent=2) + "\n")
    with replaced(config.out / "offline.parquet") as partial:
        table.to_parquet(partial, index=False)
    shown = table[list(SHOWN)].to_string(index=False, na_rep="n/a", float_format="%.4f")
    return f"{shown}\n{plural(rows[0]['frames'], 'frame')}; every column: {config.out / 'offline.json'} and .parquet"


def _find(patterns: list[str]) -> list[Path]:
    """Checkpoints that the patterns match, in their order."""
    found = {pattern: sorted(glob(f"{pattern}/config.json")) for pattern in patterns}
    if missing := [pattern for pattern, files in found.items() if not files]:
        raise MissingError(f"'{missing[0]}' matches no checkpoint's pretrained_model folder.")
    return [Path(file).parent for files in found.values() for file in files]


def _row(checkpoint: Path, dataset, episodes: list[int], config: OfflineConfig) -> dict:
    import torch

    from lerobot_constructskill.progress import Progress
    from lerobot_constructskill.rollout.agents import PolicyAgent
    from lerobot_constructskill.rollout.offline import (
        check_actions,
        observing_frames,
        offline_metrics,
        open_for,
        predict,
        spans,
    )

    agent = PolicyAgent.from_pretrained(checkpoint, config.device, backbone_precision=config.backbone_precision)
    check_actions(agent.policy, dataset)
    torch.manual_seed(config.seed)
    view = open_for(dataset, agent.policy)
    bar = Progress(spans(dataset, episodes), agent.policy.name, unit="demo", leave=False)
    with observing_frames(dataset):
        predictions = [predict(agent, view, span, config.batch_size) for span in bar]
    return {
        "policy": agent.policy.name,
        "training_seed": _training_seed(checkpoint),
        **asdict(offline_metrics(predictions)),
        # Of frozen_vit's encoder, here and in training.
        "backbone_precision": getattr(agent.policy.config, "backbone_precision", None),
        "backbone_trained_precision": getattr(getattr(agent.policy, "encoder_record", None), "precision", None),
        "checkpoint": str(checkpoint),
        "weights_sha256": file_sha256(checkpoint / "model.safetensors"),
    }


def _training_seed(checkpoint: Path) -> int | None:
    """The seed that `lerobot-train` or a study wrote beside a checkpoint."""
    for name, kind in ((TRAIN_CONFIG, TRAINED), (FACTS, SAID)):
        if (checkpoint / name).is_file():
            return kind.read(checkpoint / name).get("seed")
    return None


def main() -> None:
    run(OfflineConfig, evaluate_offline)
