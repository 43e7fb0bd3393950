"""Demonstrations and rounds into one LeRobotDataset, which says of every frame who acted, and of itself who drove."""

import json
import tempfile
from pathlib import Path
from typing import Any

import numpy as np
from lerobot.datasets import LeRobotDataset, modify_features

from lerobot_constructskill.artifacts.digests import file_sha256
from lerobot_constructskill.artifacts.disk import room_for
from lerobot_constructskill.artifacts.store import Store
from lerobot_constructskill.dagger.plan import Plan
from lerobot_constructskill.dagger.rounds import obtain_round, totals
from lerobot_constructskill.demos.columns import EXPERT, MADE, SIDECAR, dagger_features, demonstration_features
from lerobot_constructskill.demos.merge import aggregate, write_statistics
from lerobot_constructskill.demos.metadata import file_hashes, write_meanings
from lerobot_constructskill.demos.obtain import obtain_demonstrations
from lerobot_constructskill.progress import quiet


def parts_of(plan: Plan, number: int, store: Store) -> list[LeRobotDataset]:
    """The demonstrations and the first `number` rounds, each made if it is not there."""
    rounds = [obtain_round(plan, past, store)[0] for past in range(1, number + 1)]
    return [obtain_demonstrations(plan.base, store), *rounds]


def obtain_data(plan: Plan, number: int, store: Store) -> LeRobotDataset:
    """What policy `number` is trained on."""
    parts = parts_of(plan, number, store)
    if number == 0:
        return parts[0]
    made = plan.data(number)
    repo_id = f"local/{made.digest}"
    return LeRobotDataset(repo_id, root=store.obtain(made, lambda folder: _merge(plan, parts, repo_id, folder, store)))


def _merge(plan: Plan, parts: list[LeRobotDataset], repo_id: str, folder: Path, store: Store) -> None:
    base, *rounds = parts
    # The disk's room is measured before the scratch folder is gone.
    with quiet(), tempfile.TemporaryDirectory(dir=folder.parent) as scratch, room_for(folder):
        first = Path(scratch) / "demonstrations"
        _add_columns(plan, base, first)
        aggregate(repo_id, [first, *(part.root for part in rounds)], folder, Path(scratch))
    write_statistics(folder)
    write_meanings(folder, plan.task, plan.base.obs_type)
    facts = MADE.read(base.root / SIDECAR)
    facts["dagger"] = {
        "policy": plan.checkpoint(0).spec["policy"],
        "training_seed": plan.config.seed,
        "demonstrations": base.num_episodes,
        "rounds": [_provenance(plan, number, store) for number in range(1, len(parts))],
    }
    write_sidecar(folder, facts)


def write_sidecar(folder: Path, facts: dict[str, Any]) -> None:
    """Write how a data set was made, with the hashes of its files as they are."""
    (folder / SIDECAR).write_text(
        json.dumps(facts | {"sha256": file_hashes(folder)}, indent=2) + "\n", encoding="utf-8"
    )


def _add_columns(plan: Plan, base: LeRobotDataset, folder: Path) -> None:
    columns, frames = dagger_features(plan.task, plan.base.obs_type), base.num_frames
    values = {
        "dagger.round": np.zeros((frames, 1), dtype=np.int64),
        "dagger.actor": np.full((frames, 1), EXPERT, dtype=object),
        "dagger.hopeless": np.zeros((frames, 1), dtype=bool),
    }
    added = columns.keys() - demonstration_features(plan.task, plan.base.obs_type).keys()
    modify_features(base, {name: (values[name], columns[name]) for name in sorted(added)}, None, folder, base.repo_id)


def _provenance(plan: Plan, number: int, store: Store) -> dict[str, Any]:
    """Who drove in a round, and how."""
    _, outcomes = obtain_round(plan, number, store)
    weights = store.folder(plan.checkpoint(number - 1)) / "model.safetensors"
    return {
        "round": number,
        "beta": plan.config.beta(number),
        "policy_sha256": file_sha256(weights) if weights.exists() else None,
        "checkpoint": plan.checkpoint(number - 1).digest,
        "seed_start": plan.seeds(number).start,
        "patience": plan.config.patience,
        **totals(outcomes),
    }
