"""One piece of a study: some seeds of one variant in one setting, trained and evaluated."""

import hashlib
import json
from collections.abc import Iterator
from dataclasses import replace
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

import torch

from lerobot_constructskill.contract import get_task
from lerobot_constructskill.hashing import file_sha256
from lerobot_constructskill.study.agents import Agent, PolicyAgent
from lerobot_constructskill.study.checkpoints import TRAINED, Job, demonstrations, heldout_errors, train
from lerobot_constructskill.study.film import Film
from lerobot_constructskill.study.plan import Run
from lerobot_constructskill.study.references import Blind, Expert, NoOp, Random, Replay
from lerobot_constructskill.study.rollout import Outcome, roll_out
from lerobot_constructskill.study.rows import Row
from lerobot_constructskill.study.timing import timed

WITHOUT_DATA = ("no_op", "random", "expert")
"""References that use no demonstrations, whether or not another job has made them."""

PACKAGES = (
    "lerobot_env_constructskill",
    "lerobot",
    "mani_skill",
    "sapien",
    "torch",
    "openvino",
    "transformers",
    "numpy",
)


def execute(job: Job) -> Iterator[tuple[Run, list[Row]]]:
    """Train what is not trained yet, evaluate it, and yield each run's rows as soon as it has them.

    A run that fails yields one row that says why, and its log has the traceback.
    """
    # Sharp keypoints underflow, which slows training to a fifth. Threads take the setting over when they are made.
    torch.set_flush_denormal(True)
    try:
        failed = train(job) if _is_trained(job) else {}
        runs = [run for run in job.runs if run not in failed]
        agents = _agents(job, runs)
    except Exception as error:  # whatever a policy, its weights or its data set may raise becomes rows
        failed, runs, agents = dict.fromkeys(job.runs, error), [], []
    yield from ((run, [_failed(job, run, error)]) for run, error in failed.items())
    if not runs:
        return
    seeds = range(job.plan.eval_seed, job.plan.eval_seed + job.plan.episodes)
    film = Film()
    with timed(job.root, "evaluation"):
        for i, outcome in roll_out(agents, job.env, seeds, on_step=film.add):
            run, error = runs[i], outcome.error
            video = film.write(job.root, run)
            yield run, _finished(job, run, outcome, video) if error is None else [_failed(job, run, error)]


def _is_trained(job: Job) -> bool:
    return not job.runs[0].is_reference or job.runs[0].variant in TRAINED


def _agents(job: Job, runs: list[Run]) -> list[Agent]:
    name = job.runs[0].variant
    if _is_trained(job):
        kind = Blind if name == "blind" else PolicyAgent
        return [kind.from_pretrained(job.checkpoint(run)) for run in runs]
    task = get_task(job.env.get("task", "brick_to_bin"))
    if name == "replay":
        return [Replay(task, demonstrations(job), run.seed) for run in runs]
    if name == "random":
        return [Random(task, run.seed) for run in runs]
    return [{"no_op": NoOp, "expert": Expert}[name](task) for _ in runs]


def _finished(job: Job, run: Run, outcome: Outcome, video: str | None) -> list[Row]:
    common = _row(job, run, outcome.backend)
    return [
        replace(common, **vars(episode), episode=i, video=video if i == 0 else None)
        for i, episode in enumerate(outcome.episodes)
    ]


def _failed(job: Job, run: Run, error: Exception) -> Row:
    """A failure's only row: one sentence. The traceback is in the run's log."""
    job.keep(run, error)
    return replace(_row(job, run), error=" ".join(f"{type(error).__name__}: {error}".split()))


def _row(job: Job, run: Run, backend: str | None = None) -> Row:
    """What every row of a run says."""
    model = job.checkpoint(run) / "model.safetensors"
    errors = heldout_errors(job, run)
    environment = json.dumps({**job.env, "backend": backend}, sort_keys=True)
    return Row(
        plan_sha256=job.plan.sha256,
        setting=run.setting,
        variant=run.variant,
        is_reference=run.is_reference,
        training_seed=run.seed,
        evaluation_seed=job.plan.eval_seed,
        episode=0,
        heldout_mse_m2=errors.get(job.plan.settings[run.setting].data),
        heldout_mse_m2_by_data=json.dumps(errors) if errors else None,
        dataset_sha256=None if run.variant in WITHOUT_DATA else job.store.dataset_sha256(job.data),
        weights_sha256=file_sha256(model) if model.exists() else None,
        environment_sha256=hashlib.sha256(environment.encode()).hexdigest(),
        backend=backend,
        versions=json.dumps(_versions() | _backbone(job.checkpoint(run) / "config.json")),
    )


def _versions() -> dict[str, str]:
    found = {}
    for name in PACKAGES:
        try:
            found[name] = version(name)
        except PackageNotFoundError:  # openvino is of an extra
            continue
    return found


def _backbone(config_file: Path) -> dict[str, str]:
    """What a frozen_vit checkpoint's backbone is, whose weights are none of the checkpoint's."""
    config = json.loads(config_file.read_text()) if config_file.exists() else {}
    if not config.get("backbone_sha256"):
        return {}
    precision, trained = config["backbone_precision"], config["backbone_trained_precision"]
    crossed = f", trained in {trained}" if trained != precision else ""
    source = f"{config['backbone_source']}, SHA-256 {config['backbone_sha256'][:12]}"
    return {config["backbone"]: f"{source}, {precision}{crossed}"}
