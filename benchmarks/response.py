"""How far the hand moves of what is asked for, and where the fingers go: the figures of docs/tasks.md.

Usage: python benchmarks/response.py
"""

import numpy as np
from run import machine

from lerobot_constructskill.contract import get_task
from lerobot_constructskill.envs.gym_env import ConstructSkillEnv

ASKED = {"dx": (0.005, 0.02, -0.02), "dy": (0.005, 0.02, -0.02), "dz": (0.005, 0.02, -0.02), "dyaw": (0.02, 0.1)}
"""Metres or radians that a channel is asked for in each of twelve steps, after which nothing is for four."""


def place(env: ConstructSkillEnv, channel: int) -> float:
    """Where the hand is along a translation, in metres, or how far it is turned, in radians."""
    turn = env.privileged_state()["tcp_pose"][3:]
    return [*env.agent_state()[:3], 2 * np.arctan2(turn[2], turn[1])][channel]


def response(channel: int, asked: float) -> np.ndarray:
    """The share of `asked` that is moved in each step, (16,)."""
    env = ConstructSkillEnv("brick_to_bin_turned", render_backend="none")
    env.reset(seed=0)
    up, rest = np.float32([0, 0, 0.05, 0, 1]), np.float32([0, 0, 0, 0, 1])
    for action in [up] * 6 + [rest] * 6:
        env.step(action)
    places = [place(env, channel)]
    for action in [rest + asked * np.eye(5, dtype=np.float32)[channel]] * 12 + [rest] * 4:
        env.step(action)
        places.append(place(env, channel))
    env.close()
    return np.diff(places) / asked


def main() -> None:
    print(machine())
    for channel, name in enumerate(get_task("brick_to_bin_turned").action_names[:-1]):
        for asked in ASKED[name]:
            print(name, asked, response(channel, asked).round(3))
    env = ConstructSkillEnv(render_backend="none")
    env.reset(seed=0)
    for gripper in (1, 0.5, 0, -0.5, -1):
        for _ in range(30):
            env.step(np.float32([0, 0, 0, gripper]))
        print("gripper", gripper, "fingers (m)", env.agent_state()[6:].round(4))


if __name__ == "__main__":
    main()
