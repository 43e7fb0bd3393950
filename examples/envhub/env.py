"""ConstructSkill for LeRobot's EnvHub: put this file into a repository of your own on the Hub.

    make_env("YOU/constructskill", n_envs=2, trust_remote_code=True)    # lerobot.envs.make_env

The package `lerobot_env_constructskill` with its extra `sim` has to be installed. Where it is, the command line has
`--env.type=constructskill` with every option.
"""

import gymnasium as gym
from lerobot.envs import EnvConfig

from lerobot_constructskill.contract import SUITES
from lerobot_constructskill.envs.configuration_constructskill import ConstructSkillEnvConfig


def make_env(
    n_envs: int = 1, use_async_envs: bool = False, cfg: EnvConfig | None = None
) -> dict[str, dict[int, gym.vector.VectorEnv]]:
    """Every task of every suite with both cameras and the state: `{suite: {task number: vector environment}}`.

    No simulator starts before the first `reset`, so tasks that are not used cost nothing.

    Args:
        n_envs: environments in each vector environment.
        use_async_envs: a process for each of them.
        cfg: its `task`, where it has one, chooses the tasks as `--env.task` does.
    """
    task = (cfg and cfg.task) or ",".join(SUITES)
    return ConstructSkillEnvConfig(task=task, obs_type="pixels_agent_pos").create_envs(n_envs, use_async_envs)
