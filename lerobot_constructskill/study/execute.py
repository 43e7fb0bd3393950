"""One piece of a study: some seeds of a variant, trained together, evaluated in lockstep, each kept as a run's folder.

<store>/runs/<digest>/  spec.json  checkpoint (a link)  episodes.parquet  recordings.parquet (what was executed)
                        video.mp4 (of seed 0)  log.txt (if it failed)
"""

import json
from collections.abc import Callable, Iterator, Sequence
from copy import deepcopy
from dataclasses import dataclass, replace
from errno import EDQUOT, EIO, EMFILE, ENFILE, ENOLCK, ENOMEM, ENOSPC, EROFS, ESTALE, ETIMEDOUT
from functools import partial
from itertools import groupby
from pathlib import Path

import httpx
import torch
from lerobot.datasets import LeRobotDataset

from lerobot_constructskill.artifacts.code import check_unedited
from lerobot_constructskill.artifacts.digests import digest, file_sha256, finished_sha256
from lerobot_constructskill.artifacts.processor import processor
from lerobot_constructskill.artifacts.store import Store
from lerobot_constructskill.contract import get_task, held_out
from lerobot_constructskill.dagger.plan import Plan
from lerobot_constructskill.dagger.run import make_checkpoint
from lerobot_constructskill.demos.obtain import obtain_demonstrations
from lerobot_constructskill.envs.recording import RECORDINGS, Episode, write_recordings
from lerobot_constructskill.errors import MachineError, TakenError, kind_of
from lerobot_constructskill.rollout.agents import Agent, PolicyAgent, caught
from lerobot_constructskill.rollout.lockstep import Rollout, roll_out
from lerobot_constructskill.rollout.references import REFERENCES
from lerobot_constructskill.rollout.video import FirstEpisode
from lerobot_constructskill.study.rows import EpisodeRow, write_rows
from lerobot_constructskill.study.runs import Demonstrations, Run
from lerobot_constructskill.study.timing import DEMONSTRATIONS, EVALUATION, ROUNDS, TRAINING, timed
from lerobot_constructskill.training.checkpoints import read_facts, writing_checkpoint
from lerobot_constructskill.training.trainers import OF_THE_MACHINE, trainer_of

EPISODES, VIDEO, CHECKPOINT = "episodes.parquet", "video.mp4", "checkpoint"

FILMED_SEED = 0

TRIES = 3
"""Times that the machine may fail a run before that is the run's result."""

ERRNOS = (ENOSPC, EDQUOT, EROFS, EIO, EMFILE, ENFILE, ENOMEM, ESTALE, ENOLCK, ETIMEDOUT)
"""What an `OSError` says of the machine, its disks and its network."""


@dataclass(frozen=True)
class Job:
    """Runs of one variant or reference in one setting that are made in one pass.

    Args:
        runs: they differ in their seeds and, where each seed has demonstrations of its own, in these.
        store: where everything is made.
        times: folder in which is noted what took how long.
        workers: processes that generate demonstrations and simulate in rounds of DAgger.
        simulators: processes that simulate episodes; one per core by default.
    """

    runs: tuple[Run, ...]
    store: Store
    times: Path
    workers: int = 1
    simulators: int | None = None


def make_runs(job: Job) -> Iterator[Run]:
    """Make the runs of a job that nobody has made yet, and yield each as soon as its folder is there.

    A run that fails has a folder as well: one row that says why, and a log with the traceback.
    """
    with job.store.claim([run.artifact for run in job.runs]) as claimed:
        yield from (run for run in job.runs if run.artifact not in claimed)
        runs = [run for run in job.runs if run.artifact in claimed]
        failed = _train(job, runs)
        for run in runs:
            if run.seed in failed:
                yield _write_failed(job, run, failed[run.seed])
        yield from _evaluate(job, [run for run in runs if run.seed not in failed])


def obtain(job: Job, demonstrations: Demonstrations) -> LeRobotDataset:
    """The data set of some demonstrations, made if it is not there."""
    with timed(job.times, DEMONSTRATIONS):
        return obtain_demonstrations(replace(demonstrations.config, workers=job.workers), job.store)


def _train(job: Job, runs: Sequence[Run]) -> dict[int, Exception]:
    """Train those of `runs` that have no checkpoint yet, and return why some seeds could not be trained."""
    failed = {}
    with job.store.claim([run.checkpoint for run in runs if run.checkpoint]) as claimed:
        for some in _together([run for run in runs if run.checkpoint in claimed]):
            try:
                _fit(job, some)
            except Exception as error:  # whatever a policy, its weights or its data set may raise becomes rows
                lost = [run for run in some if not job.store.has(run.checkpoint)]
                failed |= dict.fromkeys([run.seed for run in lost], _let_through(job, lost, error))
    return failed


def _together(runs: Sequence[Run]) -> Iterator[list[Run]]:
    """Runs that are trained at once: those of one arm, if its trainer can and no seed drives rounds of its own."""
    for arm, group in groupby(runs, key=lambda run: run.arm):
        seeds = list(group)
        at_once = trainer_of(arm.policy).seeds_together(arm.policy) and not arm.dagger
        yield from [seeds] if at_once else ([run] for run in seeds)


def _let_through(job: Job, runs: Sequence[Run], error: Exception) -> Exception:
    """Raise what is no run's fault and may be gone the next time, so that it never stands for the run's result.

    What comes back every time does: after `TRIES` times it is returned, as any other error is, and nothing waits for
    ever for a machine that cannot do its part.
    """
    if not _is_of_the_machine(error):
        return error
    if any(job.store.notes(run.artifact) < TRIES - 1 for run in runs):
        for run in runs:
            job.store.note(run.artifact, error)
        raise error
    return error if isinstance(error, MachineError) else MachineError(f"{type(error).__name__}: {error}")


def _is_of_the_machine(error: Exception) -> bool:
    causes = [error, *_causes(error)]
    return (
        isinstance(error, TakenError | MachineError | MemoryError)
        or any(isinstance(one, ConnectionError | TimeoutError | httpx.HTTPError) for one in causes)
        or any(isinstance(one, OSError) and one.errno in ERRNOS for one in causes)
        or any(isinstance(one, RuntimeError) and any(words in str(one) for words in OF_THE_MACHINE) for one in causes)
    )


def _causes(error: BaseException) -> Iterator[BaseException]:
    while (error := error.__cause__ or error.__context__) is not None:
        yield error


def _fit(job: Job, runs: Sequence[Run]) -> None:
    arm = runs[0].arm
    training = arm.training
    if arm.dagger:
        for run in runs:
            with timed(job.times, ROUNDS, arm.id):
                plan = Plan(replace(run.dagger.config, workers=job.workers))
                make_checkpoint(plan, arm.dagger.rounds, job.store)
        return
    dataset = obtain(job, arm.demonstrations)
    own = {run.seed: partial(writing_checkpoint, job.store, run.checkpoint, arm.policy) for run in runs}
    stacks = sorted({seed // arm.stack for seed in own})
    writers = {seed: own.get(seed) for one in stacks for seed in range(one * arm.stack, (one + 1) * arm.stack)}
    kept_out = held_out(dataset.num_episodes, training.holdout)
    config = deepcopy(arm.policy)  # LeRobot writes the data set's features into it
    with timed(job.times, TRAINING, arm.id, len(runs)):
        trainer_of(config).fit(config, dataset, writers, training.epochs, training.batch_size, kept_out, job.store)


def _evaluate(job: Job, runs: Sequence[Run]) -> Iterator[Run]:
    ready = []
    for run, agent in [(run, caught(_agent, job, run)) for run in runs]:
        if isinstance(agent, Exception):
            yield _write_failed(job, run, _let_through(job, [run], agent))
        else:
            ready.append((run, agent))
    if not ready:
        return
    runs, agents = zip(*ready, strict=True)
    arm = runs[0].arm  # in the environment and in how it is evaluated, one is like the other
    first, count = arm.evaluation["seed"], arm.evaluation["episodes"]
    filmed = [number for number, run in enumerate(runs) if run.seed == FILMED_SEED]
    film = FirstEpisode(next(iter(filmed), None))
    with timed(job.times, EVALUATION, arm.id, len(runs)):
        starts = range(first, first + count)
        for number, rollout in roll_out(
            agents, arm.env, starts, on_step=film.add, filmed=filmed, n_workers=job.simulators
        ):
            if rollout.error is not None:
                yield _write_failed(job, runs[number], _let_through(job, [runs[number]], rollout.error))
            else:
                yield _write_finished(job, runs[number], rollout, partial(film.write, number))


def _agent(job: Job, run: Run) -> Agent:
    arm = run.arm
    if arm.policy is not None:
        config = arm.policy
        here = {name: getattr(config, name) for name in trainer_of(config).places}  # a path may differ by now
        return PolicyAgent.from_pretrained(job.store.folder(run.checkpoint), config.device, **here)
    dataset = obtain(job, arm.demonstrations) if arm.demonstrations else None
    return REFERENCES[arm.name].agent(get_task(arm.env["task"]), run.seed, dataset)


def _write_finished(job: Job, run: Run, rollout: Rollout, write_video) -> Run:
    row = _row(job, run, rollout.backend)
    rows = [row.filled(episode, i) for i, episode in enumerate(rollout.episodes)]
    return _write(job, run, rows, write_video, rollout.recordings(run.arm.env))


def _write_failed(job: Job, run: Run, error: Exception) -> Run:
    job.store.note(run.artifact, error)
    said = " ".join(f"{type(error).__name__}: {error}".split())
    return _write(job, run, [replace(_row(job, run), error_kind=kind_of(error), error=said)])


def _write(
    job: Job,
    run: Run,
    rows: list[EpisodeRow],
    write_video: Callable[[Path], None] = lambda path: None,
    recordings: Sequence[Episode] = (),
) -> Run:
    check_unedited(run.versions, Run(run.arm, run.seed).versions)
    with job.store.writing(run.artifact) as folder:
        folder.mkdir()
        write_rows(rows, folder / EPISODES, EpisodeRow)
        if recordings:
            write_recordings(recordings, folder / RECORDINGS)
        write_video(folder / VIDEO)
        if run.checkpoint and job.store.has(run.checkpoint):
            checkpoint = job.store.folder(run.checkpoint)
            (folder / CHECKPOINT).symlink_to(Path("..", "..", checkpoint.parent.name, checkpoint.name))
    return run


def _row(job: Job, run: Run, backend: str | None = None) -> EpisodeRow:
    """What every row of a run says."""
    arm, weights, made_of = run.arm, None, {}
    if run.checkpoint and job.store.has(run.checkpoint):
        checkpoint = job.store.folder(run.checkpoint)
        model = checkpoint / "model.safetensors"
        weights = file_sha256(model) if model.exists() else None
        made_of = read_facts(checkpoint).get("made_of", {})
    return EpisodeRow(
        run=run.artifact.digest,
        training_seed=run.seed,
        evaluation_seed=arm.evaluation["seed"],
        episode=0,
        dataset_sha256=_dataset_sha256(job, run),
        weights_sha256=weights,
        environment_sha256=digest({"environment": arm.env, "backend": backend}),
        backend=backend,
        versions=json.dumps(run.versions | made_of | _made_on(getattr(arm.policy, "device", None), backend)),
    )


def _made_on(device: str | None, backend: str | None) -> dict[str, str]:
    """The processor that made a row, and the graphics card where the policy or the renderer used one.

    Args:
        device: torch's name of the one that the policy acts on.
        backend: what simulated and rendered, as `ConstructSkillEnv.backend`.
    """
    acts = (device or "").startswith("cuda")
    if not acts and "cuda" not in (backend or ""):
        return {"processor": processor()}
    return {"processor": processor(), "card": torch.cuda.get_device_name(device if acts else None)}


def _dataset_sha256(job: Job, run: Run) -> str | None:
    made = run.arm.demonstrations and run.arm.demonstrations.artifact
    if run.dagger:
        made = run.dagger.data(run.arm.dagger.rounds)
    return finished_sha256(job.store.folder(made)) if made and job.store.has(made) else None
