"""Finds the point of no return of every failed episode of a board's policies: the last step that can be mended.

It needs the actions alone, as a replay does: the expert acts from the simulator's state.
"""

import logging
from collections.abc import Sequence
from hashlib import sha256
from pathlib import Path
from typing import Any

import numpy as np

from lerobot_constructskill.board.causes import cause
from lerobot_constructskill.board.entries import Entry
from lerobot_constructskill.board.recovered import FAILED, Lost, Recovery, path_of, write_recovered
from lerobot_constructskill.board.replay import jobs_of, open_simulator, open_workers
from lerobot_constructskill.board.submission import Claim
from lerobot_constructskill.board.takeover import EVERY, Followed, Walk, Within
from lerobot_constructskill.demos.state import PrivilegedState
from lerobot_constructskill.envs.gym_env import ConstructSkillEnv
from lerobot_constructskill.progress import Progress

TOGETHER = 6
"""Episodes that a worker searches in one simulator: half a minute, as the bar moves when they are done."""

DRAWN = 50
"""Of so many failures one is drawn by its hash, in which every tenth step is tried."""


def write_missing(root: Path, entries: Sequence[Entry], workers: int | None = None) -> list[Path]:
    """Write the tables of some entries that are not there, those of few failures first.

    A killed run goes on with the entries that it has not written.

    Args:
        root: the board's folder.
        workers: processes; one per core by default, and two at least.

    Returns:
        What was written.

    Raises:
        OSError: a worker died.
    """
    due = [one for one in entries if not one.recoveries_are_current]
    failed = {one.name: own for one in due if (own := one.failures)}
    order = sorted((one for one in due if one.name in failed), key=lambda one: len(failed[one.name]))
    total = sum(map(len, failed.values()))
    with open_workers(workers) as submit, Progress(total=total, desc="recover", unit="episode") as bar:
        running = [
            [submit(_recover, job, one.submission.sha256) for job in jobs_of(failed[one.name], TOGETHER)]
            for one in order
        ]
        for entry, futures in zip(order, running, strict=True):
            rows: list[Recovery] = []
            for future in futures:
                rows += (found := future.result())
                bar.update(len(found))
            write_recovered(path_of(root, entry.name), entry.submission.sha256, rows)
    return [path_of(root, entry.name) for entry in order]


def _recover(claims: Sequence[Claim], submission: str) -> list[Recovery]:
    """Search some failed episodes of a setting, in a simulator of their own."""
    # Each copy would warn anew of a policy's clipped actions.
    logging.getLogger("lerobot_constructskill.sim.actions").setLevel(logging.ERROR)
    env = open_simulator(claims[0].environment)
    try:
        return [recover_episode(env, claim, is_drawn(claim, submission)) for claim in claims]
    finally:
        env.close()


def is_drawn(claim: Claim, submission: str) -> bool:
    """Whether an episode is one of those whose every tenth step is tried; its hash decides."""
    return int.from_bytes(sha256(f"{submission}/{claim.label}".encode()).digest()) % DRAWN == 0


def recover_episode(env: ConstructSkillEnv, claim: Claim, drawn: bool = False) -> Recovery:
    """Search a failed episode.

    Args:
        env: a simulator of its environment, which does not render.
        drawn: try every tenth step too.
    """
    walk, extra, in_time = Walk(env, claim), Within(), Within(claim.episode_length)
    with Followed(walk) as followed:
        if followed.told is not None:
            return Recovery(*claim.key, claim.steps, lost=Lost.UNSEEN, is_drawn=drawn)
        tried = followed.search(extra, in_time)
        everywhere = followed.try_every(EVERY) if drawn else {}
    last = extra.last(tried)
    after = tried.get(0 if last is None else last + 1)
    found: dict[str, Any] = {
        "last_step": in_time.last(tried),
        "last_step_extra": last,
        "lost": cause(followed.states, claim.executed[:, -1], last),
        "is_hopeless": after is not None and after.is_hopeless,
    }
    if last is not None:
        found |= _where(walk, followed.states[last])
    tried = everywhere | tried
    steps = sorted(tried)
    took = [tried[step].took or FAILED for step in steps]
    return Recovery(*claim.key, claim.steps, **found, is_drawn=drawn, tried=steps, took=took)


def _where(walk: Walk, state: PrivilegedState) -> dict[str, Any]:
    """Phase and distances of a state, as fields of `Recovery`."""
    object_at = state.object_pose[:2]
    hand, goal = (1000 * float(np.linalg.norm(one[:2] - object_at)) for one in (state.tcp, state.bin_position))
    return {"phase": walk.expert.advise(state).phase, "hand_mm": round(hand, 1), "goal_mm": round(goal, 1)}
