"""Runs DAgger step by step; what is in the store already is taken from there."""

import json
import logging
import shutil
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from lerobot.datasets import LeRobotDatasetMetadata

from lerobot_constructskill.artifacts.folders import staged
from lerobot_constructskill.artifacts.store import Machine, Store
from lerobot_constructskill.dagger.merge import write_sidecar
from lerobot_constructskill.dagger.plan import Plan
from lerobot_constructskill.dagger.rounds import Round, totals
from lerobot_constructskill.dagger.settings import DaggerConfig
from lerobot_constructskill.demos.columns import MADE, SIDECAR
from lerobot_constructskill.errors import plural
from lerobot_constructskill.training.checkpoints import checkpoint_of
from lerobot_constructskill.training.heldout import HeldOutError, known_error
from lerobot_constructskill.training.trainers import flush_denormals

ROUNDS = "rounds.json"

logger = logging.getLogger(__name__)


@dataclass(frozen=True)
class Line:
    """A policy's results, and those of the round that it drove.

    Args:
        policy: its number; policy 0 learnt from the demonstrations alone.
        frames: of the data set that it was trained on, each with one expert's label.
        heldout_mse_m2: its error on that set's held-out episodes, in m2; None where it could not be measured, as of a
            policy whose chunks need more than single frames.
        drove: `rounds.totals` of the round that it drove, None for the last policy. With several tasks they are of all
            together, and `tasks` has those of each.
    """

    policy: int
    frames: int
    heldout_mse_m2: float | None
    drove: dict[str, Any] | None

    def __str__(self) -> str:
        said = [f"policy {self.policy}: from a data set of {plural(self.frames, 'frame')} with the expert's labels"]
        if self.heldout_mse_m2 is not None:
            said.append(f"held-out error {self.heldout_mse_m2:.3g} m2")
        if self.drove:
            drove = self.drove
            of_tasks = ", ".join(f"{name} {one['placed']}" for name, one in drove.get("tasks", {}).items())
            said.append(
                f"drove round {self.policy + 1}: placed {drove['placed']} of {drove['episodes']}"
                f"{f' ({of_tasks})' if of_tasks else ''}, {plural(drove['frames'], 'frame')}, {drove['by_expert']} of "
                "them by the expert's hand"
            )
        return "; ".join(said)


def run_dagger(
    config: DaggerConfig, store: Store, root: Path, tell: Callable[[Line], None] = lambda line: None
) -> list[Line]:
    """Make all that a configuration asks for, and write the data set, the last checkpoint and the lines to `root`.

    Raises:
        FileExistsError: `root` exists, or another process is writing it.
        InputError: nothing can be made of a field.
        OSError: the disk is full, this machine cannot render, or a process died.
    """
    flush_denormals()  # before weights are hashed, in many threads
    plan, machine = Plan.of(config), Machine(workers=config.workers, together=config.together)
    lines, last = [], config.rounds
    with staged(root) as folder:
        for line in _lines(plan, store, machine):
            lines.append(line)
            tell(line)
        folder.mkdir()
        (folder / ROUNDS).write_text(json.dumps([vars(line) for line in lines], indent=2) + "\n", encoding="utf-8")
        shutil.copytree(checkpoint_of(config.seed, store.get(plan.checkpoint(last))), folder / "checkpoint")
        _copy_data(store.get(plan.data(last)), config.repo_id, folder / "dataset")
    return lines


def _lines(plan: Plan, store: Store, machine: Machine) -> Iterator[Line]:
    for number in range(plan.config.rounds + 1):
        data, policy = plan.data(number), plan.checkpoint(number)
        store.get(policy, machine)
        error = HeldOutError(policy, plan.seed, data)
        for failure in store.get_all([error], machine).values():
            logger.warning("Policy %d is not validated: %s", number, failure.said)
        drives = number < plan.config.rounds
        drove = _drive(plan.round(number + 1), store, machine) if drives else None
        frames = LeRobotDatasetMetadata(data.repo_id, root=store.get(data, machine)).total_frames
        yield Line(number, frames, known_error(error, store), drove)


def _drive(rounds: Sequence[Round], store: Store, machine: Machine) -> dict[str, Any]:
    """Drive a round in each task, and return its sums."""
    folders = {one.task.name: store.get(one, machine) for one in rounds}
    of_tasks = {"tasks": {name: totals(folder) for name, folder in folders.items()}} if len(folders) > 1 else {}
    return totals(*folders.values()) | of_tasks


def _copy_data(data: Path, repo_id: str, folder: Path) -> None:
    """The data set under its own name."""
    shutil.copytree(data, folder, ignore=shutil.ignore_patterns("spec.json"))
    facts = MADE.read(folder / SIDECAR)
    facts["generator"]["repo_id"] = repo_id
    write_sidecar(folder, facts)
