"""Runs, the unit of a study: seeds of a variant are trained, evaluated in lockstep, and each is kept as a node.

<store>/runs/<digest>/  spec.json  checkpoint (a link)  episodes.parquet  recordings.parquet (what was executed)
                        video.mp4 (of seed 0)  log.txt (if it failed)
"""

import json
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property, partial
from pathlib import Path
from typing import Any

import torch
from lerobot.datasets import LeRobotDataset

from lerobot_constructskill.artifacts.code import code_of
from lerobot_constructskill.artifacts.digests import digest, file_sha256, finished_sha256, versions
from lerobot_constructskill.artifacts.failures import Failure
from lerobot_constructskill.artifacts.processor import processor
from lerobot_constructskill.artifacts.store import Machine, Node, Store
from lerobot_constructskill.contract import TASK_ACTION, get_task
from lerobot_constructskill.dagger.plan import Plan
from lerobot_constructskill.dagger.settings import DaggerConfig
from lerobot_constructskill.demos.node import Demonstrations
from lerobot_constructskill.envs.recording import RECORDINGS, Episode, write_recordings
from lerobot_constructskill.perturbations import Perturbation
from lerobot_constructskill.plans.plan import read_plan
from lerobot_constructskill.rollout.agents import Agent, PolicyAgent, caught
from lerobot_constructskill.rollout.lockstep import FirstEpisode, Rollout, roll_out
from lerobot_constructskill.rollout.references import REFERENCES
from lerobot_constructskill.study.rows import EpisodeRow, write_rows
from lerobot_constructskill.study.timing import timed
from lerobot_constructskill.training.checkpoints import ACTING, Checkpoints, checkpoint_of
from lerobot_constructskill.training.recipe import FACTS, SAID, Training
from lerobot_constructskill.training.trainers import Learner

EPISODES, VIDEO, CHECKPOINT = "episodes.parquet", "video.mp4", "checkpoint"

FILMED_SEED = 0

TRIES = 3
"""Times that the machine may fail a run before that is the run's result."""


@dataclass(frozen=True, eq=False)
class NamedSet:
    """Demonstrations that a study names.

    Args:
        name: what they are called.
        node: what they are made as.
        moved: by how much the seeds of their attempts are moved: 0 but for a training seed's own draw.
    """

    name: str
    node: Demonstrations
    moved: int = 0


@dataclass(frozen=True, eq=False)
class Arm:
    """A variant or a reference in one setting, on one draw: its runs differ in their seed alone.

    Args:
        setting, name, role: as in `rows.Row`.
        env: keyword arguments of `ConstructSkillEnv`.
        starts: seeds of the evaluation episodes.
        demonstrations: what it learns from or replays, if it does.
        validated_on: all demonstrations of its setting, those that every seed would share.
        learner: what is trained; None for references that are not.
        training: how.
        rounds: the rounds of DAgger that it is trained on beside the demonstrations, if it is.
    """

    setting: str
    name: str
    role: str
    env: dict[str, Any]
    starts: range
    demonstrations: NamedSet | None = None
    validated_on: tuple[NamedSet, ...] = ()
    learner: Learner | None = None
    training: Training | None = None
    rounds: DaggerConfig | None = None

    @property
    def id(self) -> str:
        return f"{self.setting}/{self.name}"

    @cached_property
    def place(self) -> dict[str, Any]:
        """Where its episodes take place: the environment, and what stands in the plan that it names."""
        plan = get_task(self.env["task"]).plan
        return self.env | ({"plan": read_plan(plan).laid()} if plan else {})


def told_in(env: Mapping[str, Any]) -> str:
    """The sentence that a policy is told in an environment, given as an arm has it."""
    return Perturbation(env["perturb"], env["perturb_seed"]).told(get_task(env["task"])).instruction


@dataclass(frozen=True, eq=False)
class Run(Node):
    """One training seed of an arm, the unit of evidence. Names are not in its specification."""

    arm: Arm
    seed: int

    kind = "runs"

    @property
    def id(self) -> str:
        return f"{self.arm.id}/seed_{self.seed}"

    def facts(self) -> dict[str, Any]:
        reference = {} if self.arm.learner else {"reference": self.arm.name}
        evaluation = {"seed": self.arm.starts.start, "episodes": len(self.arm.starts)}
        return {**reference, "seed": self.seed, "environment": self.arm.place, "evaluation": evaluation}

    def versions(self) -> dict[str, str]:
        task = get_task(self.arm.env["task"])
        return versions(*ACTING) | code_of(task.scene, __name__) | self._code_of_agent()

    def _code_of_agent(self) -> dict[str, str]:
        if self.arm.learner:
            return self.arm.learner.versions()
        reference = REFERENCES[self.arm.name]
        seen = [get_task(self.arm.env["task"]).expert] if reference.is_expert else []
        return code_of(reference.agent.__module__, *seen)

    @cached_property
    def inputs(self) -> dict[str, Node]:
        if self.arm.learner:
            return {"checkpoint": self.checkpoints}
        return {"demonstrations": self.arm.demonstrations.node} if self.arm.demonstrations else {}

    @cached_property
    def plan(self) -> Plan | None:
        """The rounds of DAgger that it drives itself."""
        arm = self.arm
        return arm.rounds and Plan(arm.rounds, arm.demonstrations.node, arm.learner, arm.training, self.seed)

    @cached_property
    def checkpoints(self) -> Checkpoints | None:
        """The node that holds its checkpoint; None for a reference that is not trained."""
        arm = self.arm
        if arm.learner is None:
            return None
        if self.plan:
            return self.plan.checkpoint(arm.rounds.rounds)
        data = arm.demonstrations
        return Checkpoints.holding(self.seed, arm.learner, arm.training, data.node, alone=bool(data.moved))

    @cached_property
    def digests(self) -> tuple[str, ...]:
        """The run's digest, then its digests on other kinds of machine."""
        others = self.arm.learner.elsewhere if self.arm.learner else ()
        return self.digest, *(Run(replace(self.arm, learner=one), self.seed).digest for one in others)


@dataclass(frozen=True)
class Job:
    """Runs of one variant or reference in one setting that are made in one pass.

    Args:
        runs: they differ in their seeds and, where each seed has demonstrations of its own, in these.
        store: where everything is made.
        times: folder of the file that says what took how long.
        machine: what makes them.
    """

    runs: tuple[Run, ...]
    store: Store
    times: Path
    machine: Machine = field(default_factory=Machine)


def make_runs(job: Job) -> Iterator[Run]:
    """Make the runs of a job that nobody has made yet, and yield each as soon as its folder is there.

    A run that fails has a folder as well: one row that says why, and a log with the traceback. A run that the machine
    fails has none until it has failed `TRIES` times, so that nothing waits for ever for a machine that cannot do its
    part.

    Raises:
        MachineError: the machine failed a run; all others are made.
    """
    with job.store.claim(job.runs) as claimed:
        yield from (run for run in job.runs if run not in claimed)
        again: list[Failure] = []
        for run, outcome in _outcomes(job, [run for run in job.runs if run in claimed]):
            if isinstance(outcome, Failure) and not _write_failed(job, run, outcome):
                again.append(outcome)
            else:
                yield run
    if again:
        raise again[0].error()


def _outcomes(job: Job, runs: Sequence[Run]) -> Iterator[tuple[Run, Failure | None]]:
    """What came of each run: None where it is written, else why it is not."""
    if not runs:
        return
    trained = {run: run.checkpoints for run in runs if run.checkpoints and not job.store.has(run.checkpoints)}
    failed = _lost(job, "demonstrations", {run: run.arm.demonstrations.node for run in runs if run.arm.demonstrations})
    failed |= _lost(job, "data", {run: one.inputs["data"] for run, one in trained.items() if run not in failed})
    failed |= _lost(job, "training", {run: one for run, one in trained.items() if run not in failed})
    yield from failed.items()
    if others := [run for run in runs if run not in failed]:
        with timed(job.times, runs[0].arm.id, "evaluation", len(others)):
            yield from _evaluate(job, others)


def _lost(job: Job, stage: str, nodes: Mapping[Run, Node]) -> dict[Run, Failure]:
    """Make a node for each run, if it is one that is kept, and return why some could not be made."""
    due = {run: node for run, node in nodes.items() if not (node.is_passing or job.store.has(node))}
    if not due:
        return {}
    different = [*dict.fromkeys(due.values())]
    with timed(job.times, next(iter(due)).arm.id, stage, len(due), len(different)):
        failed = job.store.get_all(different, job.machine)
    return {run: failed[node] for run, node in due.items() if node in failed}


def _evaluate(job: Job, runs: Sequence[Run]) -> Iterator[tuple[Run, Failure | None]]:
    made = {run: caught(_agent, job, run) for run in runs}
    yield from ((run, Failure.of(agent)) for run, agent in made.items() if isinstance(agent, Exception))
    agents = {run: agent for run, agent in made.items() if not isinstance(agent, Exception)}
    if not agents:
        return
    runs = [*agents]
    env = runs[0].arm.env  # in the environment one is like the other
    filmed = [number for number, run in enumerate(runs) if run.seed == FILMED_SEED]
    film = FirstEpisode(next(iter(filmed), None))
    how = {"on_step": film.add, "filmed": filmed, "n_workers": job.machine.simulators}
    for number, rollout in roll_out([*agents.values()], env, [run.arm.starts for run in runs], **how):
        if rollout.error is None:
            _write_finished(job, runs[number], rollout, partial(film.write, number))
        yield runs[number], rollout.error and Failure.of(rollout.error)


def _agent(job: Job, run: Run) -> Agent:
    arm = run.arm
    if arm.learner:
        return PolicyAgent.from_pretrained(_checkpoint(job, run), **arm.learner.acting)
    data = arm.demonstrations and arm.demonstrations.node
    dataset = data and LeRobotDataset(data.repo_id, root=job.store.folder(data))
    task = get_task(arm.env["task"], arm.env.get("action", TASK_ACTION))
    return REFERENCES[arm.name].agent(task, run.seed, dataset)


def _checkpoint(job: Job, run: Run) -> Path:
    return checkpoint_of(run.seed, job.store.folder(run.checkpoints))


def _write_finished(job: Job, run: Run, rollout: Rollout, write_video: Callable[[Path], None]) -> None:
    row = _row(job, run, rollout.backend)
    rows = [row.filled(episode, i) for i, episode in enumerate(rollout.episodes)]
    _write(job, run, rows, write_video, rollout.recordings(run.arm.env))


def _write_failed(job: Job, run: Run, failure: Failure) -> bool:
    """Write a run that failed; False where it is to be tried again and nothing is written."""
    job.store.note(run, failure)
    if failure.is_of_the_machine and job.store.notes(run) < TRIES:
        return False
    _write(job, run, [replace(_row(job, run), error_kind=failure.kind, error=failure.said)])
    return True


def _write(
    job: Job,
    run: Run,
    rows: list[EpisodeRow],
    write_video: Callable[[Path], None] = lambda path: None,
    recordings: Sequence[Episode] = (),
) -> None:
    with job.store.writing(run) as folder:
        folder.mkdir()
        write_rows(rows, folder / EPISODES, EpisodeRow)
        if recordings:
            write_recordings(recordings, folder / RECORDINGS)
        write_video(folder / VIDEO)
        if run.checkpoints and job.store.has(run.checkpoints):
            (folder / CHECKPOINT).symlink_to(Path("..", "..") / _checkpoint(job, run).relative_to(job.store.root))


def _row(job: Job, run: Run, backend: str | None = None) -> EpisodeRow:
    """The columns that all rows of a run share."""
    arm, weights, stands_on = run.arm, None, {}
    if run.checkpoints and job.store.has(run.checkpoints):
        model = _checkpoint(job, run) / "model.safetensors"
        weights = file_sha256(model) if model.exists() else None
        stands_on = SAID.read(_checkpoint(job, run) / FACTS)["made_of"]
    return EpisodeRow(
        run=run.digest,
        training_seed=run.seed,
        evaluation_seed=arm.starts.start,
        episode=0,
        dataset_sha256=_dataset_sha256(job, run),
        weights_sha256=weights,
        environment_sha256=digest({"environment": arm.place, "backend": backend}),
        backend=backend,
        versions=json.dumps(run.spec["versions"] | stands_on | _made_on(run, backend)),
    )


def _made_on(run: Run, backend: str | None) -> dict[str, str]:
    """The processor that made a row, and the graphics card where the policy or the renderer used one.

    Args:
        backend: what simulated and rendered, as `ConstructSkillEnv.backend`. A run that failed has none, and names no
            card, for a card that fails does not tell its name.
    """
    device = str(run.arm.learner.config.device) if run.arm.learner else ""
    acts = device.startswith("cuda")
    if backend is None or not (acts or "cuda" in backend):
        return {"processor": processor()}
    return {"processor": processor(), "card": torch.cuda.get_device_name(device if acts else None)}


def _dataset_sha256(job: Job, run: Run) -> str | None:
    """Hash of the data set that the run learnt from, or replays."""
    made = run.checkpoints.demonstrations if run.checkpoints else run.inputs.get("demonstrations")
    return finished_sha256(job.store.folder(made)) if made and job.store.has(made) else None
