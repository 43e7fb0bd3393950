"""A DAgger run, step by step; whatever is in the store already is taken from there."""

import json
import shutil
from collections.abc import Callable, Iterator
from copy import deepcopy
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

from lerobot_constructskill.artifacts.folders import staged
from lerobot_constructskill.artifacts.store import Store
from lerobot_constructskill.contract import held_out
from lerobot_constructskill.dagger.merge import obtain_data, parts_of, write_sidecar
from lerobot_constructskill.dagger.plan import Plan
from lerobot_constructskill.dagger.rounds import obtain_evaluation, obtain_round, totals
from lerobot_constructskill.demos.columns import MADE, SIDECAR
from lerobot_constructskill.errors import plural
from lerobot_constructskill.training.checkpoints import read_facts, writing_checkpoint
from lerobot_constructskill.training.trainers import flush_denormals, trainer_of

ROUNDS = "rounds.json"


@dataclass(frozen=True)
class Line:
    """What there is to say of a policy, and of the round that it drove.

    Args:
        policy: its number; policy 0 learnt from the demonstrations alone.
        frames: of the data set that it was trained on, each with one expert's label.
        heldout_mse_m2: its error on that set's held-out episodes, in m2, where its trainer tells.
        drove: `rounds.totals` of the round that it drove, None for the last policy.
        evaluated: the same of its evaluation, None without one.
    """

    policy: int
    frames: int
    heldout_mse_m2: float | None
    drove: dict[str, Any] | None
    evaluated: dict[str, Any] | None

    def __str__(self) -> str:
        said = [f"policy {self.policy}: trained on {plural(self.frames, 'frame')} with the expert's labels"]
        if self.heldout_mse_m2 is not None:
            said.append(f"held-out error {self.heldout_mse_m2:.3g} m2")
        if self.evaluated:
            said.append(f"evaluated: placed {self.evaluated['placed']} of {self.evaluated['episodes']}")
        if self.drove:
            drove = self.drove
            said.append(
                f"drove round {self.policy + 1}: placed {drove['placed']} of {drove['episodes']}, "
                f"{plural(drove['frames'], 'frame')}, {drove['by_expert']} of them by the expert's hand"
            )
        return "; ".join(said)


def run_dagger(plan: Plan, store: Store, root: Path, tell: Callable[[Line], None] = lambda line: None) -> list[Line]:
    """Make all that a plan asks for, and write the data set, the last checkpoint and the lines to `root`.

    Raises:
        FileExistsError: `root` exists, or another process is writing it.
        InputError: nothing can be made of a field.
        OSError: the disk is full, this machine cannot render, or a process died.
    """
    flush_denormals()
    lines = []
    with staged(root) as folder:
        for line in _lines(plan, store):
            lines.append(line)
            tell(line)
        folder.mkdir()
        (folder / ROUNDS).write_text(json.dumps([vars(line) for line in lines], indent=2) + "\n", encoding="utf-8")
        shutil.copytree(store.folder(plan.checkpoint(plan.config.rounds)), folder / "checkpoint")
        _copy_data(plan, store, folder / "dataset")
    return lines


def _lines(plan: Plan, store: Store) -> Iterator[Line]:
    for number in range(plan.config.rounds + 1):
        checkpoint, data = obtain_checkpoint(plan, number, store), obtain_data(plan, number, store)
        evaluated = totals(obtain_evaluation(plan, number, store)) if plan.config.eval_episodes else None
        drives = number < plan.config.rounds
        drove = totals(obtain_round(plan, number + 1, store)[1]) if drives else None
        error = read_facts(checkpoint).get("heldout_mse_m2")
        yield Line(number, data.num_frames, error, drove, evaluated)


def obtain_checkpoint(plan: Plan, number: int, store: Store) -> Path:
    """The folder of policy `number`, which is trained if it is not there."""
    made = plan.checkpoint(number)
    with store.claim([made]) as missing:
        if missing:
            make_checkpoint(plan, number, store)
    return store.folder(made)


def make_checkpoint(plan: Plan, number: int, store: Store) -> None:
    """Train policy `number`, whose checkpoint the caller has claimed, on rounds that those before it drive."""
    for past in range(number):
        obtain_checkpoint(plan, past, store)
        obtain_round(plan, past + 1, store)
    config, training, trainer = deepcopy(plan.policy), plan.config.training, trainer_of(plan.policy)
    data = obtain_data(plan, number, store)
    kept_out = held_out(data.num_episodes, training.holdout)
    writers = {plan.config.seed: partial(writing_checkpoint, store, plan.checkpoint(number), plan.policy)}
    with trainer.joined(config, data, parts_of(plan, number, store), store):
        trainer.fit(config, data, writers, training.epochs, training.batch_size, kept_out, store)


def _copy_data(plan: Plan, store: Store, folder: Path) -> None:
    """The data set under its own name."""
    shutil.copytree(store.folder(plan.data(plan.config.rounds)), folder, ignore=shutil.ignore_patterns("spec.json"))
    facts = MADE.read(folder / SIDECAR)
    facts["generator"]["repo_id"] = plan.config.repo_id
    write_sidecar(folder, facts)
