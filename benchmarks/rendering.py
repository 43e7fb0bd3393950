"""RGB environment steps per second at 224 x 224: our scene, ours with original meshes, and PickCube-v1.

Also ours as a Gymnasium environment with one of its two cameras rendered, and with both; and a step with one camera
against what physics and the picture take of it.

Ours are stepped through LeRobot's vector environment, PickCube-v1 as its users step it. All take turns, a block
of steps each, so that a change of the machine's load meets all of them; each is measured by the clock and in CPU time,
which a busy machine disturbs less. Both with lavapipe's own number of threads and with one, each in its own process.
PyTorch has the threads that it takes by itself.
"""

import os
import subprocess
import sys

import gymnasium as gym
import numpy as np
from measure import CpuTimer, Timer, report

from lerobot_constructskill.contract import IMAGE_SIZE
from lerobot_constructskill.envs.configuration_constructskill import ConstructSkillEnvConfig
from lerobot_constructskill.envs.gym_env import ConstructSkillEnv

BLOCKS, STEPS = 6, 20


def pick_cube():
    """ManiSkill's stock task as its users step it without a GPU; the image size is the only change."""
    import mani_skill.envs  # noqa: F401

    size = {"width": IMAGE_SIZE, "height": IMAGE_SIZE}
    env = gym.make(
        "PickCube-v1",
        obs_mode="rgb",
        control_mode="pd_ee_delta_pose",
        sim_backend="physx_cpu",
        render_backend="cpu",
        sensor_configs=size,
    )
    env.reset(seed=0)
    action = np.zeros(7, dtype=np.float32)
    return lambda: env.step(action)[0]["sensor_data"]["base_camera"]["rgb"].cpu().numpy()


def ours(light_robot: bool):
    config = ConstructSkillEnvConfig(light_robot=light_robot, render_backend="cpu", episode_length=10_000)
    env = config.create_envs(n_envs=1)["constructskill"][0]
    env.reset(seed=0)
    action = np.array([[0, 0, 0, 1]], dtype=np.float32)
    return lambda: env.step(action)


def of_two_cameras(cameras: tuple[str, ...]):
    env = ConstructSkillEnv(
        obs_type="pixels_agent_pos", cameras=cameras, light_robot=True, render_backend="cpu", episode_length=10_000
    )
    env.reset(seed=0)
    action = np.array([0, 0, 0, 1], dtype=np.float32)
    return lambda: env.step(action)


def of_parts(parts: Timer):
    """A step with one camera; `parts` adds up what the simulator's own calls for physics and the picture take."""
    env = ConstructSkillEnv(
        obs_type="pixels_agent_pos", cameras=("wrist",), light_robot=True, render_backend="cpu", episode_length=10_000
    )
    env.reset(seed=0)
    scene, (camera,) = env.started().scene, env.started()._sensors.values()
    for owner, name in ((scene, "step"), (scene, "update_render"), (camera, "capture"), (camera, "get_obs")):
        setattr(owner, name, timed(getattr(owner, name), parts))
    action = np.array([0, 0, 0, 1], dtype=np.float32)
    return lambda: env.step(action)


def timed(function, timer: Timer):
    def call(*args, **kwargs):
        with timer:
            return function(*args, **kwargs)

    return call


def measure(threads: str) -> None:
    parts = Timer()
    steps = {"ours": ours(True), "original meshes": ours(False), "PickCube-v1": pick_cube()}
    steps |= {"one camera": of_two_cameras(("wrist",)), "two cameras": of_two_cameras(("base", "wrist"))}
    steps |= {"in parts": of_parts(parts)}
    timers = {name: (Timer(), CpuTimer()) for name in steps}
    for step in steps.values():
        step()
    parts.seconds = 0.0
    for _ in range(BLOCKS):
        for name, step in steps.items():
            clock, cpu = timers[name]
            with clock, cpu:
                for _ in range(STEPS):
                    step()
    n, whole = BLOCKS * STEPS, timers["in parts"][0].seconds
    what, alone = f"ms of an environment's step, one camera, {threads}", "of these, physics and the picture"
    report(what, 1000 * whole / n, alone, 1000 * parts.seconds / n, less_is_better=True)
    for which, unit in enumerate(("steps/s by the clock", "steps per second of CPU time")):
        rates = {name: BLOCKS * STEPS / pair[which].seconds for name, pair in timers.items()}
        what = f"RGB environment {unit}, {threads}"
        report(what, rates["ours"], "stock PickCube-v1", rates["PickCube-v1"], target=7)
        report(what, rates["ours"], "our scene, original meshes", rates["original meshes"], target=3)
        report(f"{what}, the wrist camera alone", rates["one camera"], "both cameras", rates["two cameras"])


def main() -> None:
    if len(sys.argv) > 1:
        measure(sys.argv[1])
        return
    # lavapipe reads its number of threads once, when a process starts to render.
    free = {name: value for name, value in os.environ.items() if name != "LP_NUM_THREADS"}
    for threads, surroundings in (
        (f"{os.cpu_count()} render threads", free),
        ("one render thread", free | {"LP_NUM_THREADS": "1"}),
    ):
        subprocess.run([sys.executable, __file__, threads], env=surroundings, check=True)


if __name__ == "__main__":
    main()
