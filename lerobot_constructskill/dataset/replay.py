"""Executes a recorded demonstration again, in a simulator of its own as when it was recorded."""

from dataclasses import dataclass

import numpy as np

from lerobot_constructskill.dataset.dataset import DataSet
from lerobot_constructskill.envs.gym_env import ConstructSkillEnv


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


def replay(data: DataSet, episode: int) -> ReplayResult:
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
