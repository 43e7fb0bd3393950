"""Resets per second of CPU time after a stepped episode, in workers as rollouts, generation and replay have them.

A reset builds the scene anew, as an episode has to know nothing of the one before it. Against it: the same worker
whose garbage collector looks at all that was imported, as ManiSkill has it do whenever a scene ends. They take turns,
each in a process of its own, with and without rendering (one camera).

Also the first picture of a process, against SAPIEN's own shader, which has a table computed for it.
"""

import os
import time
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context

import numpy as np
from measure import report

TURNS, EPISODES = 3, 10
ALL_OBJECTS = "the garbage collector looks at what was imported"


def seconds_a_reset(spare_imports: bool, render_backend: str) -> float:
    """CPU seconds of a reset and one step, in this process."""
    from lerobot_constructskill.envs import gym_env

    if not spare_imports:
        gym_env._spare_imports = lambda: None
    env = gym_env.ConstructSkillEnv(
        "brick_to_bin_shifted", "pixels_agent_pos", render_backend=render_backend, cameras=("wrist",)
    )
    hover = np.array([0, 0, 0, 1], dtype=np.float32)
    env.reset(seed=0)
    start = time.process_time()
    for seed in range(EPISODES):
        env.step(hover)
        env.reset(seed=seed)
    return (time.process_time() - start) / EPISODES


def seconds_to_the_first_picture(own_shader: bool) -> float:
    """CPU seconds of the first reset of this process, whose imports are done."""
    import lerobot_constructskill.sim.register  # noqa: F401
    from lerobot_constructskill.envs.gym_env import ConstructSkillEnv
    from lerobot_constructskill.sim import scene

    if not own_shader:
        scene.colour_shader = lambda: None
    env = ConstructSkillEnv("brick_to_bin_shifted", render_backend="cpu")
    start = time.process_time()
    env.reset(seed=0)
    return time.process_time() - start


def in_turns(seconds_of: Callable[..., float], *arguments: object) -> dict[bool, float]:
    """Mean seconds with and without what is ours, each time in a process of its own."""
    seconds = {True: 0.0, False: 0.0}
    for _ in range(TURNS):
        for ours in seconds:
            with ProcessPoolExecutor(1, get_context("spawn")) as worker:
                seconds[ours] += worker.submit(seconds_of, ours, *arguments).result() / TURNS
    return seconds


def main() -> None:
    os.environ |= {"LP_NUM_THREADS": "1", "OMP_NUM_THREADS": "1"}
    for render_backend, what in (("cpu", "rendering"), ("none", "without rendering, as in a replay")):
        seconds = in_turns(seconds_a_reset, render_backend)
        report(f"resets per second of CPU time, {what}", 1 / seconds[True], ALL_OBJECTS, 1 / seconds[False])
    seconds = in_turns(seconds_to_the_first_picture)
    what = "first pictures of a process per second of CPU time"
    report(what, 1 / seconds[True], "SAPIEN's own shader", 1 / seconds[False])


if __name__ == "__main__":
    main()
