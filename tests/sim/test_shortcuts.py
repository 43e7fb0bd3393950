"""What is done sooner than ManiSkill and SAPIEN do it comes to the same numbers, to the last bit."""

import gymnasium as gym
import numpy as np
import pytest

import lerobot_constructskill.sim.register  # noqa: F401
from lerobot_constructskill.contract import TASKS

pytestmark = pytest.mark.sim


def make(**kwargs):
    return gym.make(TASKS["brick_to_bin"].env_id, **kwargs).unwrapped


def test_the_quick_controllers_move_the_robot_as_maniskills_do():
    envs = [make(obs_mode="none", render_backend="none", robot_uids=uid) for uid in ("panda", "constructskill_panda")]
    for env in envs:
        env.reset(seed=0)
    rng = np.random.default_rng(0)
    for step in range(30):
        action = rng.uniform(-1.5, 1.5, 7).astype(np.float32)
        action[3:6] *= step % 3  # no rotation, some, and more than the controller lets through
        for env in envs:
            env.step(action)
        theirs, ours = (env.agent.robot.get_qpos().numpy() for env in envs)
        np.testing.assert_array_equal(ours, theirs)
    tcp = envs[0].agent.robot.pose.inv() * envs[0].agent.tcp.pose
    np.testing.assert_array_equal(envs[1].agent_state()[:, :3].numpy(), tcp.p.numpy())


def test_colour_pictures_do_not_depend_on_what_else_is_rendered():
    lean, full = (make(obs_mode=mode, render_backend="cpu") for mode in ("rgb", "rgb+segmentation"))
    packs = [env._sensor_configs["base"].shader_pack for env in (lean, full)]
    assert packs[0].endswith("colour") and packs[1] == "minimal"
    pictures = [env.reset(seed=0)[0]["sensor_data"]["base"]["rgb"].numpy() for env in (lean, full)]
    np.testing.assert_array_equal(*pictures)
