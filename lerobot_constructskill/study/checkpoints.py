"""The checkpoints of a study: what is trained for a job, once, as ordinary LeRobot policies."""

import json
import logging
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import dataclass, replace
from datetime import datetime
from pathlib import Path
from typing import Any

from lerobot.datasets import LeRobotDataset
from lerobot.utils.device_utils import auto_select_torch_device

from lerobot_constructskill.contract import held_out
from lerobot_constructskill.errors import UserError, full_traceback
from lerobot_constructskill.parsing import decode
from lerobot_constructskill.policies.frozen_vit.configuration_frozen_vit import FrozenViTChunkConfig
from lerobot_constructskill.policies.frozen_vit.precision import AUTO, resolve_precision
from lerobot_constructskill.pools import cores
from lerobot_constructskill.staging import staged
from lerobot_constructskill.study.plan import Run, StudyPlan, Training, Variant
from lerobot_constructskill.study.prepare import Store
from lerobot_constructskill.study.timing import timed
from lerobot_constructskill.study.train import heldout_mse, save_checkpoint, train_seeds

TRAINED = ("blind", "untrained")
"""References that train a policy."""

logger = logging.getLogger(__name__)

HELDOUT_FILE = "heldout_mse_m2.json"

LOADERS = 4
"""LeRobot's own number of loading processes. Each imports all of LeRobot: no more than there are cores to spare."""


@dataclass(frozen=True)
class Job:
    """Runs of one variant, or of one reference, in one setting; they differ in their seeds alone.

    Args:
        plan: the study.
        runs: its runs.
        root: the study's folder.
        store: where data sets are.
    """

    plan: StudyPlan
    runs: tuple[Run, ...]
    root: Path
    store: Store

    @property
    def env(self) -> dict[str, Any]:
        """Fields of the environment."""
        return self.plan.settings[self.runs[0].setting].env

    @property
    def data(self) -> str:
        """The `constructskill-generate` configuration of its demonstrations."""
        run = self.runs[0]
        own = None if run.is_reference else self.plan.variants[run.variant].data
        return own or self.plan.settings[run.setting].data

    def folder(self, run: Run) -> Path:
        return self.root / "runs" / run.id

    def checkpoint(self, run: Run) -> Path:
        return self.folder(run) / "pretrained_model"

    def log(self, run: Run) -> Path:
        """What a run said, and every traceback of its failures."""
        return self.root / "logs" / f"{run.id}.log"

    def keep(self, run: Run, error: Exception) -> None:
        """Add an exception's traceback to the run's log."""
        log = self.log(run)
        log.parent.mkdir(parents=True, exist_ok=True)
        with log.open("a") as file:
            file.write(f"{datetime.now():%Y-%m-%d %H:%M:%S}\n{full_traceback(error)}\n")


def settle_precision(plan: StudyPlan) -> StudyPlan:
    """The plan with `backbone_precision: auto` as what it means here, so that no study mixes two kinds of CPU."""
    return replace(plan, variants={name: _settled(variant) for name, variant in plan.variants.items()})


def _settled(variant: Variant) -> Variant:
    policy = variant.policy
    if policy["type"] != "frozen_vit":
        return variant
    device = policy.get("device") or auto_select_torch_device()
    precision = resolve_precision(policy.get("backbone_precision", AUTO), device)
    return replace(variant, policy=policy | {"backbone_precision": precision})


def demonstrations(job: Job, data: str | None = None) -> LeRobotDataset:
    """The data set of a configuration, of the job's own by default."""
    with timed(job.root, "demonstrations"):
        return job.store.demonstrations(data or job.data)


def heldout_errors(job: Job, run: Run) -> dict[str, float | None]:
    """The run's translation error in m2 on what its setting holds out of each configuration's demonstrations."""
    file = job.folder(run) / HELDOUT_FILE
    return json.loads(file.read_text()) if file.exists() else {}


def train(job: Job) -> dict[Run, Exception]:
    """Train the runs of a job that have no checkpoint yet, each of which appears whole or not at all.

    Returns:
        The runs that could not be trained, and why.
    """
    missing = [run for run in job.runs if not job.folder(run).exists()]
    if not missing:
        return {}
    variant = job.plan.variant_of(missing[0])
    training = replace(job.plan.training, **variant.training)
    if variant.policy["type"] == "frozen_vit":
        _train_together(job, missing, dict(variant.policy), training)
        return {}
    dataset, failed = demonstrations(job), {}
    for run in missing:
        try:
            _train_stock(job, run, dataset, variant.policy, training)
        except Exception as error:  # the other seeds have nothing to do with it
            failed[run] = error
    return failed


def _train_together(job: Job, runs: list[Run], policy: dict[str, Any], training: Training) -> None:
    reference = runs[0].variant if runs[0].is_reference else None
    if reference == "untrained":
        policy["backbone_path"] = str(job.store.untrained_weights(policy.get("backbone", "dinov2_vits14")))
    is_blind = reference == "blind"
    features = _features(job, job.data, policy, is_blind)
    fields = {name: value for name, value in policy.items() if name != "type"}
    config = decode(FrozenViTChunkConfig, fields | {"save_backbone": False, "push_to_hub": False})
    with timed(job.root, "training"):
        policies = train_seeds(config, features, [run.seed for run in runs], training)
    stats = features.meta.stats
    errors = {
        data: heldout_mse(policies, validation, training.holdout, stats)
        for data, validation in _validation_sets(job, features, policy, is_blind)
    }
    for number, run in enumerate(runs):
        with staged(job.folder(run)) as folder:
            save_checkpoint(policies[number], features, folder / job.checkpoint(run).name)
            own = {data: of_all[number] for data, of_all in errors.items()}
            (folder / HELDOUT_FILE).write_text(json.dumps(own))


def _features(job: Job, data: str, policy: dict[str, Any], is_blind: bool) -> LeRobotDataset:
    made = demonstrations(job, data)
    with timed(job.root, "encoding"):
        return job.store.features(made, policy, is_blind)


def _validation_sets(
    job: Job, features: LeRobotDataset, policy: dict[str, Any], is_blind: bool
) -> Iterator[tuple[str, LeRobotDataset]]:
    """Yield what its setting validates on, but for sets that cannot be made or lack a column of its own set."""
    for data in job.plan.data_of(job.runs[0].setting):
        try:
            other = features if data == job.data else _features(job, data, policy, is_blind)
        except (OSError, UserError) as error:
            logger.warning("%s is not validated on %s: %s", job.runs[0].variant, data, error)
            job.keep(job.runs[0], error)
            continue
        if other.meta.features.keys() >= features.meta.features.keys():
            yield data, other


def _train_stock(job: Job, run: Run, dataset: LeRobotDataset, policy: dict[str, Any], training: Training) -> None:
    """Train any other policy type with lerobot-train, for as many passes over the same demonstrations."""
    kept = sorted({*range(dataset.num_episodes)} - {*held_out(dataset.num_episodes, training.holdout)})
    frames = sum(dataset.meta.episodes["length"][i] for i in kept)
    steps = training.epochs * -(-frames // training.batch_size)
    with staged(job.folder(run)) as folder:
        command = [
            str(Path(sys.executable).parent / "lerobot-train"),
            f"--dataset.repo_id={dataset.repo_id}",
            f"--dataset.root={dataset.root}",
            f"--dataset.episodes={kept}",
            *(f"--policy.{name}={_flag(value)}" for name, value in policy.items()),
            "--policy.push_to_hub=false",
            f"--batch_size={training.batch_size}",
            f"--steps={steps}",
            f"--save_freq={steps}",
            "--env_eval_freq=0",
            f"--num_workers={min(cores() - 1, LOADERS)}",
            f"--seed={run.seed}",
            f"--output_dir={folder}",
        ]
        log = job.log(run)
        log.parent.mkdir(parents=True, exist_ok=True)
        with timed(job.root, "training"), log.open("a") as output:
            status = subprocess.run(command, stdout=output, stderr=subprocess.STDOUT).returncode
        if status:
            said = log.read_text().strip().splitlines() or ["nothing"]
            raise RuntimeError(f"lerobot-train ended with status {status}; {log} ends with: {said[-1]}")
        last = (folder / "checkpoints" / "last" / "pretrained_model").resolve()
        last.rename(folder / job.checkpoint(run).name)


def _flag(value: Any) -> str:
    return value if isinstance(value, str) else json.dumps(value)
