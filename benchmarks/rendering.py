"""RGB environment steps per second at 224 x 224 in one process: our scene, ours with original meshes, PickCube-v1.

The three are stepped in turn, a block of steps each, so that a change of the machine's load meets all of them.
PyTorch gets one thread: the simulator's tensors are tiny, and waking a second one for them costs more than it gives.
"""

import gymnasium as gym
import numpy as np
import torch
from measure import Timer, report

from lerobot_constructskill.contract import IMAGE_SIZE
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
    env = ConstructSkillEnv(light_robot=light_robot, render_backend="cpu", episode_length=10_000)
    env.reset(seed=0)
    action = np.array([0, 0, 0, 1], dtype=np.float32)
    return lambda: env.step(action)


def main() -> None:
    torch.set_num_threads(1)
    steps = {"ours": ours(True), "original meshes": ours(False), "PickCube-v1": pick_cube()}
    timers = {name: Timer() for name in steps}
    for step in steps.values():
        step()
    for _ in range(BLOCKS):
        for name, step in steps.items():
            with timers[name]:
                for _ in range(STEPS):
                    step()
    rates = {name: BLOCKS * STEPS / timer.seconds for name, timer in timers.items()}
    unit = "RGB environment steps/s, one process"
    report(unit, rates["ours"], "stock PickCube-v1", rates["PickCube-v1"], target=7)
    report(unit, rates["ours"], "our scene, original meshes", rates["original meshes"], target=3)


if __name__ == "__main__":
    main()
