"""Demonstrations and rounds as one LeRobotDataset. Frames name their actor, the sidecar names each round's policy."""

import json
import tempfile
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from lerobot.datasets import LeRobotDataset, modify_features

from lerobot_constructskill.artifacts.code import code_of
from lerobot_constructskill.artifacts.digests import versions
from lerobot_constructskill.artifacts.disk import room_for
from lerobot_constructskill.artifacts.store import Machine, Node
from lerobot_constructskill.contract import Task
from lerobot_constructskill.dagger.rounds import DRIVEN, DRIVING, OUTCOMES, Round, totals
from lerobot_constructskill.demos.columns import (
    EXPERT,
    LANGUAGE,
    MADE,
    SIDECAR,
    dagger_features,
    demonstration_features,
)
from lerobot_constructskill.demos.language import annotate
from lerobot_constructskill.demos.merge import aggregate, write_statistics
from lerobot_constructskill.demos.metadata import file_hashes, write_meanings
from lerobot_constructskill.demos.node import Demonstrations
from lerobot_constructskill.progress import quiet


@dataclass(frozen=True, eq=False)
class MergedSet(Node):
    """Demonstrations and the rounds that follow them.

    Args:
        base: the demonstrations.
        rounds: round by round, each of every task in the order of the base.
    """

    base: Demonstrations
    rounds: tuple[Round, ...]

    kind = "dagger"

    @property
    def parts(self) -> tuple[Node, ...]:
        return self.base, *self.rounds

    def facts(self) -> dict[str, Any]:
        return {}

    def versions(self) -> dict[str, str]:
        return versions(*DRIVING) | code_of(__name__)

    @cached_property
    def inputs(self) -> dict[str, Node]:
        tasks, names = len(self.base.config.rows), [f"round_{one.number}" for one in self.rounds]
        if tasks > 1:
            names = [f"{name}_{place % tasks}" for place, name in enumerate(names)]
        return {"demonstrations": self.base, **dict(zip(names, self.rounds, strict=True))}

    def make(self, folder: Path, inputs: Mapping[str, Path], machine: Machine) -> None:
        """Merge the parts and say in the sidecar who drove."""
        config, repo_id = self.base.config, self.repo_id
        base = LeRobotDataset(self.base.repo_id, root=inputs["demonstrations"])
        _, *driven = (inputs[name] for name in self.inputs)
        # The disk's room is measured before the scratch folder is gone.
        with quiet(), tempfile.TemporaryDirectory(dir=folder.parent) as scratch, room_for(folder):
            first = Path(scratch) / "demonstrations"
            self._add_columns(base, first)
            aggregate(repo_id, [first, *driven], folder, Path(scratch))
        write_statistics(folder)
        if config.annotate:
            annotate(folder, self._tasks(driven))
        write_meanings(folder, config.rows, config.seen, config.state)
        facts = MADE.read(base.root / SIDECAR)
        facts["dagger"] = {
            "policy": self.rounds[0].policy.learner.facts(),
            "training_seed": self.rounds[0].policy.seeds.start,
            "demonstrations": base.num_episodes,
            "rounds": [_provenance(one, root) for one, root in zip(self.rounds, driven, strict=True)],
        }
        write_sidecar(folder, facts)

    def _add_columns(self, base: LeRobotDataset, folder: Path) -> None:
        config = self.base.config
        told = config.rows[0], config.seen, config.state
        columns, frames = dagger_features(*told), base.num_frames
        values = {
            "dagger.round": np.zeros((frames, 1), dtype=np.int64),
            "dagger.actor": np.full((frames, 1), EXPERT, dtype=object),
            "dagger.hopeless": np.zeros((frames, 1), dtype=bool),
        }
        added = columns.keys() - demonstration_features(*told).keys()
        gone = [*LANGUAGE] if config.annotate else None  # until they are written for all
        named = {name: (values[name], columns[name]) for name in sorted(added)}
        modify_features(base, named, gone, folder, base.repo_id)

    def _tasks(self, driven: Sequence[Path]) -> list[Task]:
        """The task of each episode.

        Args:
            driven: the folders of the rounds.
        """
        tasks = [task for task in self.base.config.rows for _ in range(self.base.config.episodes)]
        for one, root in zip(self.rounds, driven, strict=True):
            tasks += [one.task for outcome in DRIVEN.read(root / OUTCOMES).episodes if outcome.frames]
        return tasks


def write_sidecar(folder: Path, facts: dict[str, Any]) -> None:
    """Write how a data set was made, with the hashes of its files as they are."""
    (folder / SIDECAR).write_text(
        json.dumps(facts | {"sha256": file_hashes(folder)}, indent=2) + "\n", encoding="utf-8"
    )


def _provenance(driven: Round, root: Path) -> dict[str, Any]:
    """Who drove in a round, and how."""
    return {
        "round": driven.number,
        **({"task": driven.task.name} if driven.is_of_several else {}),
        "beta": driven.beta,
        "policy_sha256": DRIVEN.read(root / OUTCOMES).policy_sha256,
        "checkpoint": driven.policy.digest,
        "seed_start": driven.seeds.start,
        "patience": driven.patience,
        **totals(root),
    }
