"""Executes a submission's actions again, without rendering, and says which episodes end otherwise than claimed."""

import os
import random
from collections.abc import Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass, fields
from itertools import batched, groupby

from lerobot_constructskill.artifacts.pools import Submit, cores, open_pool
from lerobot_constructskill.board.protocol import PHYSICS, Setting
from lerobot_constructskill.board.submission import Claim, Submission, is_replayable, width
from lerobot_constructskill.envs.gym_env import ConstructSkillEnv
from lerobot_constructskill.envs.recording import FOLDER, Outcome, deciding
from lerobot_constructskill.errors import InputError
from lerobot_constructskill.progress import Progress

TOGETHER = 8
"""Episodes that a worker replays in one simulator, one after another."""


@dataclass(frozen=True)
class Verdict:
    """What a replay showed.

    Args:
        replayed: episodes that were executed.
        failed: episodes that have an error in place of actions: there is nothing to execute, and they count as failed.
        steps: that were executed.
        differences: a sentence for every episode that does not end as claimed.
        versions: of the packages that decide what an action does, here.
    """

    replayed: int
    failed: int
    steps: int
    differences: list[str]
    versions: dict[str, str]


def replay(submission: Submission, workers: int | None = None, sample: int | None = None) -> Verdict:
    """Execute every action of a submission, or those of a sample of its episodes.

    Args:
        workers: processes; one per core by default.
        sample: so many episodes, drawn by the operating system's randomness; all by default.

    Raises:
        InputError: it was made with another physics than is replayed.
        OSError: a worker died.
    """
    declaration = submission.declaration
    if not is_replayable(declaration):
        raise InputError(
            f"The submission was made with '{declaration.backend}'; only {PHYSICS} can be replayed, and results of "
            "another backend stay claimed and have no rank."
        )
    acted = [claim for claim in submission.claims if claim.error is None]
    chosen = acted if sample is None else random.SystemRandom().sample(acted, min(sample, len(acted)))
    chosen = sorted(chosen, key=lambda claim: claim.key)
    settings = declaration.settings
    jobs = [
        (settings[name], some)
        for name, claims in groupby(chosen, key=lambda claim: claim.setting)
        for some in batched(claims, TOGETHER)  # noqa: B911  the last one may be shorter
    ]
    found = _run(jobs, workers, sum(claim.steps for claim in chosen))
    others = _other_versions(declaration.versions, deciding())
    return Verdict(
        replayed=len(chosen),
        failed=len(submission.claims) - len(acted),
        steps=sum(claim.steps for claim in chosen),
        differences=[f"{said}{others}." for said in found],
        versions={name: value for name, value in deciding().items() if name != "processor"},
    )


def _run(jobs: Sequence[tuple[Setting, Sequence[Claim]]], workers: int | None, steps: int) -> list[str]:
    found: list[str] = []
    with open_workers(workers) as submit, Progress(total=steps, desc="replay", unit="step") as bar:
        running = [(submit(_replay, setting, claims), claims) for setting, claims in jobs]
        for future, claims in running:
            found += future.result()
            bar.update(sum(claim.steps for claim in claims))
    return found


def _other_versions(there: dict[str, str], here: dict[str, str]) -> str:
    """What may be the reason for a difference that is nobody's fault."""
    other = {name: ours for name, ours in here.items() if there.get(name) != ours}
    told = [f"{name} {_said(there.get(name))} there, {ours} here" for name, ours in other.items()]
    return f" (made with others: {'; '.join(told)})" if told else " (with the same versions and make of processor)"


def _said(version: str | None) -> str:
    return "unknown" if version is None else ascii(version[:40])


def open_workers(workers: int | None = None) -> AbstractContextManager[Submit]:
    """Processes for simulators, one per core by default, and two at least.

    With one, the pool would be this process, and it may have a simulator already: one that renders and one that does
    not cannot share a process.
    """
    return open_pool("processes", max(2, workers or cores()))


def open_simulator(setting: Setting, render_backend: str = "none") -> ConstructSkillEnv:
    """A setting's environment, by default without rendering. It does not record what a recording has it do."""
    os.environ.pop(FOLDER, None)
    return ConstructSkillEnv(
        setting.task,
        episode_length=setting.episode_length,
        render_backend=render_backend,
        perturb=setting.perturb,
        perturb_seed=setting.perturb_seed,
    )


def _replay(setting: Setting, claims: Sequence[Claim]) -> list[str]:
    """What differs of some episodes of a setting, in a simulator of their own."""
    env = open_simulator(setting)
    try:
        return [said for claim in claims if (said := difference(env, claim, width(setting)))]
    finally:
        env.close()


def difference(env: ConstructSkillEnv, claim: Claim, numbers: int) -> str | None:
    """In what a claim differs from what its actions, of so many numbers each, come to; None where it does not."""
    outcome, is_over = Outcome(claim.evaluation_seed), False
    env.reset(seed=claim.evaluation_seed)
    for action in claim.actions.reshape(-1, numbers):
        if is_over:
            return f"{claim.where}: its episode ends after {outcome.steps} steps, and its actions go on"
        _, _, terminated, truncated, info = env.step(action)
        outcome.count(info)
        is_over = terminated or truncated
    if not is_over:
        return f"{claim.where}: its actions end after {outcome.steps} steps, and its episode goes on"
    return _told(claim, outcome)


def _told(claim: Claim, outcome: Outcome) -> str | None:
    """In what a claim differs from what came of its actions."""
    pairs = [(one.name, getattr(claim, one.name), getattr(outcome, one.name)) for one in fields(Outcome)]
    told = [f"{name} is {came}, not {said}" for name, said, came in pairs if said != came]
    return f"{claim.where}: {', '.join(told)}" if told else None
