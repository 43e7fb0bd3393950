"""The held-out error of a checkpoint on some demonstrations, as a node of a store."""

import json
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

from lerobot.datasets import LeRobotDataset

from lerobot_constructskill.artifacts.code import code_of
from lerobot_constructskill.artifacts.store import Machine, Node, Store
from lerobot_constructskill.files import Json
from lerobot_constructskill.rollout.offline import heldout_mse
from lerobot_constructskill.training.checkpoints import Checkpoints, checkpoint_of
from lerobot_constructskill.training.recipe import held_out_of

FILE = "heldout.json"

ERROR = Json("a held-out error", dict[str, float | None])


@dataclass(frozen=True, eq=False)
class HeldOutError(Node):
    """The translation error of a training seed's policy on the episodes of some demonstrations that are held out."""

    checkpoints: Checkpoints
    seed: int
    demonstrations: Node

    kind = "heldout"

    def facts(self) -> dict[str, Any]:
        return {"seed": self.seed, "holdout": self.checkpoints.training.holdout}

    def versions(self) -> dict[str, str]:
        return code_of(__name__, heldout_mse.__module__)

    @cached_property
    def inputs(self) -> dict[str, Node]:
        learner = self.checkpoints.learner
        data = learner.trainer.learns_from(learner.config, self.demonstrations)
        return {"checkpoint": self.checkpoints, "data": data}

    def make(self, folder: Path, inputs: Mapping[str, Path], machine: Machine) -> None:
        """Measure the error. Raises as `rollout.offline.heldout_mse` does."""
        dataset = LeRobotDataset(self.inputs["data"].repo_id, root=inputs["data"])
        episodes = held_out_of(dataset, self.checkpoints.training.holdout)
        checkpoint = checkpoint_of(self.seed, inputs["checkpoint"])
        error = heldout_mse(checkpoint, dataset, episodes, **self.checkpoints.learner.acting)
        folder.mkdir()
        (folder / FILE).write_text(json.dumps({"mse_m2": error}) + "\n", encoding="utf-8")


def known_error(node: HeldOutError, store: Store) -> float | None:
    """The error in m2; None where it has not been measured, or no episode was held out."""
    return ERROR.read(store.folder(node) / FILE)["mse_m2"] if store.has(node) else None
