"""Executes a submission's actions again, without rendering, and finds the episodes that end otherwise than claimed."""

import os
import random
from collections.abc import Callable, Iterable, Sequence
from contextlib import AbstractContextManager
from itertools import batched, groupby
from typing import Any

from lerobot_constructskill.artifacts.pools import Submit, cores, open_pool
from lerobot_constructskill.board.protocol import PHYSICS
from lerobot_constructskill.board.submission import SCORES, Claim, Submission
from lerobot_constructskill.board.verification import different
from lerobot_constructskill.envs.gym_env import ConstructSkillEnv
from lerobot_constructskill.envs.recording import FOLDER, Episode, deciding
from lerobot_constructskill.errors import InputError
from lerobot_constructskill.progress import Progress

TOGETHER = 8
"""Episodes that a worker replays in one simulator, one after another."""

SHOWN = 10
"""Number of differences that a message lists."""

OTHER_MAKE = (
    " Makes of processors differ in the last bits of physics, on which an episode seldom depends: verify it on the "
    "make that it was made on."
)


def replay_submission(submission: Submission, workers: int | None = None, sample: int | None = None) -> list[Claim]:
    """Execute every action of a submission, or those of a sample of its episodes.

    Args:
        workers: processes; one per core by default.
        sample: so many episodes, drawn by the operating system's randomness; all by default.

    Returns:
        The episodes that were executed, without those that failed with an error and have no actions.

    Raises:
        InputError: an episode does not end as claimed, or it was made with another physics than is replayed.
        OSError: a worker died.
    """
    declaration = submission.declaration
    if not declaration.is_replayable:
        raise InputError(
            f"The submission was made with '{declaration.backend}'; only {PHYSICS} can be replayed, and results of "
            "another backend stay claimed and have no rank."
        )
    claims = [claim for claim in submission.claims if claim.error is None]
    if sample is not None:
        claims = random.SystemRandom().sample(claims, min(sample, len(claims)))
    if differences := _execute(sorted(claims, key=lambda claim: claim.key), workers):
        more = len(differences) - SHOWN
        raise InputError(
            f"{len(differences)} of {len(claims)} replayed episodes are not as claimed: "
            f"{'. '.join(differences[:SHOWN])}.{f' And {more} more.' if more > 0 else ''} "
            f"{_reason(declaration.versions)}"
        )
    return claims


def _execute(claims: Sequence[Claim], workers: int | None) -> list[str]:
    """The differences of some episodes, which are in the order of their settings."""
    jobs = jobs_of(claims)
    found: list[str] = []
    steps = sum(claim.steps for claim in claims)
    with open_workers(workers) as submit, Progress(total=steps, desc="replay", unit="step") as bar:
        for job, future in [(job, submit(_replay, job)) for job in jobs]:
            found += future.result()
            bar.update(sum(claim.steps for claim in job))
    return found


def jobs_of(claims: Iterable[Claim], together: int = TOGETHER) -> list[tuple[Claim, ...]]:
    """Split episodes that are in the order of their settings into those that one simulator runs, one after another."""
    return [
        some
        for _, own in groupby(claims, key=lambda claim: (claim.setting, claim.action))
        for some in batched(own, together)  # noqa: B911  the last one may be shorter
    ]


def _reason(there: dict[str, str]) -> str:
    """A sentence about versions that differ, which may be the reason for a difference that is nobody's fault."""
    here = deciding()
    if not (others := different(there, here)):
        return "It was made with the same versions and revisions, and on the same make of processor."
    other_make = OTHER_MAKE if "processor" in others else ""
    told = "; ".join(f"{name} {was!a:.60} there, {now} here" for name, (was, now) in others.items())
    return f"It was made with others: {told}.{other_make}"


def open_workers(workers: int | None = None) -> AbstractContextManager[Submit]:
    """Open a pool of processes for simulators, one per core by default, and two at least.

    With one, the pool would be this process, and it may have a simulator already: one that renders and one that does
    not cannot share a process.
    """
    return open_pool("processes", max(2, workers or cores()))


def open_simulator(environment: dict[str, Any], render_backend: str = "none") -> ConstructSkillEnv:
    """Open `ConstructSkillEnv(**environment)`, by default without rendering. It records no episode."""
    os.environ.pop(FOLDER, None)
    return ConstructSkillEnv(**environment, render_backend=render_backend)


def _replay(claims: Sequence[Claim]) -> list[str]:
    """The differences of some episodes of a setting, in a simulator of their own."""
    env = open_simulator(claims[0].environment)
    try:
        return [said for claim in claims if (said := difference(env, claim))]
    finally:
        env.close()


def difference(env: ConstructSkillEnv, claim: Claim, see: Callable[[], None] = lambda: None) -> str | None:
    """Execute a claim's actions and name what ends otherwise than claimed; None where all is as claimed.

    Args:
        see: called after the reset and after every step.
    """
    episode, is_over = Episode(claim.evaluation_seed), False
    env.reset(seed=claim.evaluation_seed)
    see()
    for action in claim.executed:
        if is_over:
            return f"{claim.label}: its episode ends after {episode.steps} steps, and its actions go on"
        _, _, terminated, truncated, info = env.step(action)
        episode.add(action, info)
        is_over = terminated or truncated
        see()
    if not is_over:
        return f"{claim.label}: its actions end after {episode.steps} steps, and its episode goes on"
    said = claim.outcome | {name: score for name in SCORES if (score := getattr(claim, name)) is not None}
    came = {name: getattr(episode, name) for name in said}
    told = [f"{name} is {came[name]}, not {value}" for name, value in said.items() if came[name] != value]
    return f"{claim.label}: {', '.join(told)}" if told else None
