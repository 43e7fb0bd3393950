"""`constructskill-replay`: execute every recorded action again, and say which demonstrations end as recorded."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from lerobot_constructskill.bounds import Checked, Episodes, RepoId, Text
from lerobot_constructskill.dataset.dataset import DataSet, open_dataset
from lerobot_constructskill.dataset.hub import locate
from lerobot_constructskill.envs.gym_env import ConstructSkillEnv
from lerobot_constructskill.errors import InputError, plural
from lerobot_constructskill.progress import Progress
from lerobot_constructskill.scripts.console import run


@dataclass
class ReplayConfig(Checked):
    """Replay a data set in the simulator; exit status 1 if an outcome differs."""

    repo_id: RepoId | None = None  # its name; downloaded from the Hub unless root is given
    root: Path | None = None  # its folder
    revision: Text | None = None  # tag, branch or commit on the Hub
    episodes: Episodes | None = None  # which to replay; default: all


@dataclass(frozen=True)
class ReplayResult:
    """What came of one episode's executed actions.

    Args:
        same_outcome: reward and success are as recorded at every step.
        deviation: largest difference of any number of `observation.state`, and of `sim.joint_positions` where they
            were recorded, from the recorded one, in m and rad.
    """

    same_outcome: bool
    deviation: float


def replay_episode(data: DataSet, episode: int) -> ReplayResult:
    """Start from the episode's seed and execute what was executed."""
    span, config = data.spans()[episode], data.config
    states = ["observation.state", *(["sim.joint_positions"] if data.has_joints else [])]
    recorded = np.concatenate([data.column(name)[span] for name in states], axis=1)
    outcomes = np.stack([data.column("next.reward")[span], data.column("next.success")[span]], axis=1)
    env = ConstructSkillEnv(config.task, config.obs_type, len(outcomes) + 1, config.light_robot, render_backend="none")
    try:
        env.reset(seed=int(data.column("sim.seed")[span.start]))
        found, reached = [], []
        for action in data.column("dart.executed_action")[span]:
            found.append(np.concatenate([env.agent_state(), env.privileged_state()["joint_positions"]]))
            reached.append(env.step(action)[1:3])
    finally:
        env.close()
    deviation = np.abs(np.array(found)[:, : recorded.shape[1]] - recorded).max()
    return ReplayResult(bool((np.array(reached, dtype=float) == outcomes).all()), float(deviation))


def replay_all(config: ReplayConfig) -> str:
    """Replay and return the verdict.

    Raises:
        FileNotFoundError: there is no such data set.
        ValueError: no such episode, or outcomes that differ.
        OSError: this machine cannot render.
    """
    data = open_dataset(locate(config.repo_id, config.root, config.revision))
    everything = range(len(data.episodes))
    episodes = list(everything) if config.episodes is None else config.episodes
    if not episodes or not set(episodes) <= set(everything):
        raise InputError(f"episodes must be among 0 to {len(everything) - 1}, not {episodes}.")
    replays = {episode: replay_episode(data, episode) for episode in Progress(episodes, "replay", unit="demo")}
    different = [str(episode) for episode, one in replays.items() if not one.same_outcome]
    if different:
        raise InputError(f"{len(different)} of {len(replays)} did not end as recorded: {', '.join(different)}.")
    deviation = max(one.deviation for one in replays.values())
    ended = f"{plural(len(replays), 'demonstration')} ended as recorded"
    return f"{ended}; the largest deviation from a recorded state is {deviation:.2g}."


def main() -> None:
    run(ReplayConfig, replay_all)
