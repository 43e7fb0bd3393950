"""The contract that is written down is what the simulator does."""

import json

import gymnasium as gym
import numpy as np
import pytest

import lerobot_constructskill.sim.register  # noqa: F401
from lerobot_constructskill.contract import CAMERAS, FINGER_TARGETS, OBS_TYPES, TASKS, TCP_IN_HAND
from lerobot_constructskill.envs.gym_env import ConstructSkillEnv
from lerobot_constructskill.interface import describe_task

pytestmark = pytest.mark.sim

TASK = "brick_to_bin_turned"


@pytest.fixture(scope="module")
def scene():
    env = gym.make(TASKS[TASK].env_id, obs_mode="rgb", cameras=OBS_TYPES["pixels_agent_pos"]).unwrapped
    env.reset(seed=0)
    for _ in range(3):  # a hand that has moved and turned
        env.step(np.array([0.3, 0.2, 0.4, 0.1, -0.2, 0.5, 1], dtype=np.float32))
    yield env
    env.close()


@pytest.mark.parametrize("name", CAMERAS)
def test_a_camera_stands_and_sees_as_the_contract_says(scene, name):
    said = json.loads(json.dumps(describe_task(TASKS[TASK], CAMERAS)))["cameras"][name]
    true = scene.get_sensor_params()[name]
    np.testing.assert_allclose(said["intrinsics"], true["intrinsic_cv"][0], atol=1e-3)
    frame = np.eye(4)
    if said["frame"] != "world":
        frame = scene.agent.robot.links_map[said["frame"]].pose.to_transformation_matrix()[0].numpy()
    to_camera = np.linalg.inv(frame @ said["pose"])
    np.testing.assert_allclose(to_camera[:3], true["extrinsic_cv"][0], atol=1e-4)
    picture = scene.get_sensor_images()[name]["rgb"][0]
    assert picture.shape[:2] == (said["height"], said["width"])
    assert said["vertical_fov_rad"] == pytest.approx(2 * np.arctan(said["height"] / 2 / said["intrinsics"][1][1]))


def test_the_robot_and_its_gripper_are_where_the_contract_says(scene):
    said = describe_task(TASKS[TASK], ())
    base, hand, tcp = (
        scene.agent.robot.links_map[name].pose for name in ("panda_link0", "panda_hand", "panda_hand_tcp")
    )
    np.testing.assert_allclose(base.raw_pose[0], [*said["robot"]["base_in_world"], 1, 0, 0, 0], atol=1e-6)
    in_hand = (hand.inv() * tcp).p[0]
    np.testing.assert_allclose(in_hand, TCP_IN_HAND, atol=1e-6)
    fingers = scene.agent.controller.controllers["gripper"].config
    assert (fingers.lower, fingers.upper) == FINGER_TARGETS


@pytest.mark.parametrize("channel, asked", [(0, -0.02), (2, 0.02), (3, 0.05)])
def test_the_hand_moves_the_share_of_what_is_asked_for_that_the_contract_says(channel, asked):
    env = ConstructSkillEnv(TASK, render_backend="none")
    env.reset(seed=0)
    action = np.eye(5, dtype=np.float32)[channel] * asked + np.float32([0, 0, 0, 0, 1])
    places = []
    for _ in range(9):
        env.step(action)
        turn = env.privileged_state()["tcp_pose"][3:]
        places.append([*env.agent_state()[:3], 2 * np.arctan2(turn[2], turn[1])][channel])
    env.close()
    share = describe_task(TASKS[TASK], ())["action"]["moved_share"]
    np.testing.assert_allclose(np.diff(places)[2:] / asked, share, atol=0.02)
