"""The environment as Gymnasium and LeRobot see it."""

import gc
import json
import os
import subprocess
import sys
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import forkserver, get_context

import gymnasium
import numpy as np
import pytest
import torch
from gymnasium.utils.env_checker import check_env
from lerobot.envs.utils import (
    check_env_attributes_and_types,
    env_to_policy_features,
    preprocess_observation,
)
from scipy.spatial.transform import Rotation

from lerobot_constructskill.contract import ACTION_SCALE, IMAGE_SIZE, OBS_TYPES, SUITES, TASKS
from lerobot_constructskill.demos.demonstrate import demonstrate
from lerobot_constructskill.demos.expert import ExpertConfig
from lerobot_constructskill.demos.noise import NoiseConfig
from lerobot_constructskill.demos.pick_place import PickPlaceExpert
from lerobot_constructskill.envs.configuration_constructskill import ConstructSkillEnvConfig
from lerobot_constructskill.envs.gym_env import ConstructSkillEnv
from lerobot_constructskill.errors import InputError, MachineError, UserError

HOVER = np.array([0, 0, 0, 1], dtype=np.float32)
UP_CLOSED = np.array([0.02, -0.01, 0.05, -1], dtype=np.float32)
NEW_ROLLOUT = {"lerobot_new_rollout": True}


@pytest.fixture(scope="module")
def env():
    env = ConstructSkillEnv(obs_type="pixels_agent_pos", episode_length=6)
    yield env
    env.close()


@pytest.mark.parametrize(
    "field, value", [("task", "brick"), ("obs_type", "state"), ("episode_length", 0), ("render_backend", "tpu")]
)
@pytest.mark.parametrize("build", [ConstructSkillEnv, ConstructSkillEnvConfig])
def test_bad_fields_are_refused_in_one_sentence(build, field, value):
    with pytest.raises(UserError, match=str(value)) as refused:
        build(**{field: value})
    assert "\n" not in str(refused.value)


def test_lerobot_which_films_its_evaluations_is_given_something_to_film_with():
    ConstructSkillEnv(render_backend="none")
    with pytest.raises(UserError, match="one of auto, gpu, cpu, not 'none'"):
        ConstructSkillEnvConfig(render_backend="none")


@pytest.mark.sim
def test_the_state_is_a_position_an_axis_angle_and_two_fingers():
    env = ConstructSkillEnv("brick_to_bin_turned", "pixels_agent_pos", render_backend="none")
    env.reset(seed=0)
    for _ in range(8):
        state = env.step(np.array([0.02, 0.0, 0.03, 0.08, 1.0]))[0]["agent_pos"]
    w, *xyz = env.privileged_state()["tcp_pose"][3:]
    turn = Rotation.from_rotvec(state[3:6]).inv() * Rotation.from_quat([*xyz, w])
    assert turn.magnitude() < 1e-3 and state[3] > 0 and abs(state[4]) > 0.01
    robot = env._env.unwrapped.agent.robot
    qpos = robot.get_qpos()
    names = [joint.name for joint in robot.active_joints]
    for name, value in (("panda_finger_joint1", 0.01), ("panda_finger_joint2", 0.03)):
        qpos[:, names.index(name)] = value
    robot.set_qpos(qpos)
    np.testing.assert_allclose(env.agent_state()[6:], [0.01, 0.03], atol=1e-6)
    env.close()


@pytest.mark.parametrize("cameras", [("wrist",), (), ("base", "lidar")])
def test_cameras_that_an_observation_does_not_have_are_refused(cameras):
    with pytest.raises(UserError, match="must be some of base, which pixels has"):
        ConstructSkillEnv(cameras=cameras)


@pytest.mark.sim
@pytest.mark.parametrize("perturb", ["", "sensor=2"])
def test_a_camera_shows_the_same_whether_or_not_another_is_rendered(perturb):
    seen = {}
    for cameras in (("wrist",), ("base",), None):
        env = ConstructSkillEnv(obs_type="pixels_agent_pos", perturb=perturb, cameras=cameras)
        observations = [env.reset(seed=3)[0], *(env.step(UP_CLOSED)[0] for _ in range(3))]
        assert env.observation_space.contains(observations[-1])
        seen[cameras] = [{"state": obs["agent_pos"]} | obs["pixels"] for obs in observations]
        env.close()
    for cameras in (("wrist",), ("base",)):
        for one, all_of_them in zip(seen[cameras], seen[None], strict=True):
            assert one.keys() == {"state", *cameras}
            for name, value in one.items():
                np.testing.assert_array_equal(value, all_of_them[name])


@pytest.mark.parametrize("field, value", [("max_parallel_tasks", 2), ("fps", 10)])
def test_what_lerobot_offers_and_the_tasks_cannot_do_is_refused(field, value):
    with pytest.raises(UserError, match=field):
        ConstructSkillEnvConfig(**{field: value})


@pytest.mark.parametrize("task", TASKS)
@pytest.mark.parametrize("obs_type", OBS_TYPES)
def test_config_and_environment_declare_the_same_features(task, obs_type):
    config = ConstructSkillEnvConfig(task=task, obs_type=obs_type)
    env = ConstructSkillEnv(**config.gym_kwargs)
    features = env_to_policy_features(config)
    cameras = {f"observation.images.{name}" for name in env.observation_space["pixels"]}
    assert {name for name in features if "images" in name} == cameras
    assert features["action"].shape == env.action_space.shape
    assert ("observation.state" in features) == ("agent_pos" in env.observation_space.spaces)
    assert env.task_description == TASKS[task].instruction
    assert env._max_episode_steps == TASKS[task].horizon
    channels = env.contract["action"]["channels"]
    assert [channel["name"] for channel in channels] == list(TASKS[task].action_names)
    for edge in ("low", "high"):
        np.testing.assert_allclose([channel[edge] for channel in channels], getattr(env.action_space, edge))
    assert {camera["key"] for camera in env.contract["cameras"].values()} == cameras
    assert ("state" in env.contract) == ("observation.state" in features)
    config.__post_init__()
    assert env_to_policy_features(config) == features


@pytest.mark.parametrize("suite", SUITES)
def test_a_suite_is_one_vector_environment_a_task_under_its_name(suite):
    envs = ConstructSkillEnvConfig(task=suite).create_envs(n_envs=1)
    assert {name: [vector.call("task")[0] for vector in tasks.values()] for name, tasks in envs.items()} == {
        suite: list(SUITES[suite])
    }


def test_tasks_and_suites_can_be_named_together():
    envs = ConstructSkillEnvConfig(task="brick_to_bin,joints, block_to_bin").create_envs(n_envs=1)
    assert {suite: list(tasks) for suite, tasks in envs.items()} == {
        "constructskill": [0, 1],
        "joints": [*range(len(SUITES["joints"]))],
    }


@pytest.mark.parametrize(
    "task, word", [("brick_to_bin,brick_to_bin_turned", "actions differ"), ("bins,brick_to_bin", "twice")]
)
def test_selections_that_no_policy_could_be_asked_are_refused(task, word):
    with pytest.raises(UserError, match=word):
        ConstructSkillEnvConfig(task=task)


@pytest.mark.parametrize(
    ("metres", "sent"),
    [
        ("0x1.64694cp-4", "0x1.bd839ep-1"),
        ("-0x1.975b4cp-4", "-0x1.fd321ep-1"),
        ("-0x1.4826ecp-5", "-0x1.9a30a6p-2"),
        ("0x1.e24f82p-6", "0x1.2d71b0p-2"),
    ],
)
def test_metres_become_maniskills_numbers_with_the_rounding_that_recorded_data_sets_replay_with(metres, sent):
    """Divided in float32. Multiplied by ten, or divided in float64, each has another last bit."""
    one, other = (float.fromhex(number) for number in (metres, sent))
    action = np.array([one, -one, one, 1], np.float32)
    assert ConstructSkillEnv().maniskill_action(action).tolist() == [other, -other, other, 0, 0, 0, 1]


@pytest.mark.sim
def test_a_positive_dyaw_turns_the_hand_to_the_left_by_about_a_third_of_what_was_asked():
    env = ConstructSkillEnv("brick_to_bin_turned", render_backend="none")
    env.reset(seed=0)
    before = env.privileged_state()["tcp_pose"]
    for _ in range(5):
        env.step(np.array([0, 0, 0, 0.1, 1], dtype=np.float32))
    after = env.privileged_state()["tcp_pose"]
    env.close()
    turned = 2 * np.arctan2(after[5], after[4]) - 2 * np.arctan2(before[5], before[4])
    assert 0.1 < turned < 0.5


USES = (lambda env: env.step(HOVER), ConstructSkillEnv.privileged_state, ConstructSkillEnv.agent_state)


@pytest.mark.parametrize("use", [*USES, ConstructSkillEnv.render])
def test_nothing_is_had_of_an_episode_before_the_first_reset(use):
    with pytest.raises(RuntimeError, match="reset"):
        use(ConstructSkillEnv())


@pytest.mark.sim
def test_a_simulator_without_an_episode_and_a_closed_environment_show_nothing():
    env = ConstructSkillEnv(render_backend="none")
    assert env.backend.startswith("physx_cpu")
    for _ in range(2):
        for use in USES:
            with pytest.raises(RuntimeError, match="reset"):
                use(env)
        env.reset(seed=1)
        env.close()


@pytest.mark.parametrize("build", [ConstructSkillEnv, ConstructSkillEnvConfig])
def test_a_brick_that_is_drawn_too_large_for_its_bin_is_refused_at_once(build):
    build(task="brick_to_bin_40mm", perturb="size=2")
    with pytest.raises(UserError, match="too large for the bin, 3 mm larger"):
        build(task="brick_to_bin_3mm", perturb="size=2")


@pytest.mark.sim
@pytest.mark.filterwarnings("ignore")
def test_gymnasiums_own_check_passes(env):
    check_env(env)


@pytest.mark.sim
def test_success_is_in_every_info_and_the_end_is_a_truncation(env):
    _, info = env.reset(seed=0)
    assert info["is_success"] is False
    for step in range(6):
        _, reward, terminated, truncated, info = env.step(HOVER)
        assert (reward, terminated, info["is_success"]) == (0.0, False, False)
        assert truncated == (step == 5)


@pytest.mark.sim
def test_equal_seeds_give_equal_episodes_and_images(env):
    def run():
        frames = [env.reset(seed=3)[0]]
        frames += [env.step(UP_CLOSED)[0] for _ in range(4)]
        return frames

    for first, second in zip(run(), run(), strict=True):
        np.testing.assert_array_equal(first["agent_pos"], second["agent_pos"])
        for name in OBS_TYPES["pixels_agent_pos"]:
            np.testing.assert_array_equal(first["pixels"][name], second["pixels"][name])


@pytest.mark.sim
def test_actions_are_metres_in_the_base_frame(env):
    env.reset(seed=0)
    before = env.agent_state()
    for _ in range(6):
        env.step(np.array([0.02, 0, 0.02, 1], dtype=np.float32))
    moved = env.agent_state()[:3] - before[:3]
    # the PD spring covers a good third of what is asked for in each step
    assert 0.2 * 0.12 < moved[0] < 0.12 and 0.2 * 0.12 < moved[2] < 0.12 and abs(moved[1]) < 0.01


@pytest.mark.sim
def test_no_element_of_the_state_is_constant_over_an_episode(env):
    states = [env.reset(seed=0)[0]["agent_pos"]]
    for step in range(6):
        sign = 1 if step < 3 else -1
        states.append(env.step(np.array([0.05 * sign, 0.05, 0.05, -sign]))[0]["agent_pos"])
    assert (np.ptp(states, axis=0) > 0).all()


@pytest.mark.sim
@pytest.mark.parametrize("action", [np.zeros(7), np.zeros((1, 4)), np.array([0, 0, np.nan, 1])])
def test_bad_actions_are_refused(env, action):
    env.reset(seed=0)
    with pytest.raises(ValueError, match="4 finite numbers"):
        env.step(action)


@pytest.mark.sim
def test_translations_are_clipped_not_rescaled(env):
    def reach(dx):
        env.reset(seed=0)
        env.step(np.array([dx, 0, 0, 1], dtype=np.float32))
        return env.agent_state()

    np.testing.assert_array_equal(reach(ACTION_SCALE), reach(3 * ACTION_SCALE))


@pytest.fixture
def fresh_fork_server(monkeypatch):
    """A fork server that is yet to start, on a machine where asking NVML for GPUs works without one."""
    if not torch.cuda.is_available():
        monkeypatch.setenv("CUDA_VISIBLE_DEVICES", "")
    forkserver._forkserver._stop()


def cannot_use_cuda() -> bool:
    return torch.cuda._is_in_bad_fork()


@pytest.mark.sim
@pytest.mark.parametrize("use_async_envs", [False, True])
def test_vector_environments_follow_lerobots_contract(use_async_envs, fresh_fork_server):
    config = ConstructSkillEnvConfig(obs_type="pixels_agent_pos", episode_length=3)
    vector = config.create_envs(n_envs=2, use_async_envs=use_async_envs)["constructskill"][0]
    try:
        obs, info = vector.reset(seed=[7, 8], options=NEW_ROLLOUT)
        own = ConstructSkillEnv(**config.gym_kwargs).contract
        assert [json.loads(text) for text in info["contract"]] == list(vector.call("contract")) == [own, own]
        if not use_async_envs:
            check_env_attributes_and_types(vector)
        assert list(vector.call("_max_episode_steps")) == [3, 3]
        assert vector.unwrapped.metadata["render_fps"] == config.fps
        batch = preprocess_observation(obs)
        assert batch["observation.images.base"].shape == (2, 3, IMAGE_SIZE, IMAGE_SIZE)
        assert batch["observation.state"].shape == (2, 8)
        assert list(vector.call("task_description")) == [TASKS[config.task].instruction] * 2

        for _ in range(3):
            frozen, _, _, truncated, info = vector.step(np.stack([UP_CLOSED, UP_CLOSED]))
            assert info["is_success"].shape == (2,)
        assert truncated.all()
        assert vector.metadata["autoreset_mode"] is gymnasium.vector.AutoresetMode.DISABLED
        for _ in range(3):  # after its end an episode stands still, whatever is asked for, and stays ended
            after, reward, terminated, truncated, _ = vector.step(np.stack([HOVER, HOVER]))
            np.testing.assert_array_equal(after["agent_pos"], frozen["agent_pos"])
            assert (reward == 0).all() and truncated.all() and not terminated.any()
        again, _ = vector.reset(seed=[7, 8])
        np.testing.assert_array_equal(again["agent_pos"], obs["agent_pos"])
        assert not np.any(vector.step(np.stack([HOVER, HOVER]))[2:4])
        while not vector.step(np.stack([HOVER, HOVER]))[3].all():
            pass
        vector.reset(options={"reset_mask": np.array([True, False])})
        assert vector.step(np.stack([HOVER, HOVER]))[3].tolist() == [False, True]
        if use_async_envs:  # a worker that inherits CUDA can use neither it nor Vulkan on a GPU
            with ProcessPoolExecutor(1, get_context("forkserver")) as pool:
                assert not pool.submit(cannot_use_cuda).result()
    finally:
        vector.close()


@pytest.mark.sim
def test_a_machine_without_a_vulkan_device_is_told_so_in_one_sentence():
    code = "from lerobot_constructskill.envs.gym_env import ConstructSkillEnv as E; E().reset()"
    nowhere = {
        "VK_DRIVER_FILES": "/nonexistent",
        "VK_ICD_FILENAMES": "/nonexistent",
        "CUDA_VISIBLE_DEVICES": "",
    }
    run = subprocess.run([sys.executable, "-c", code], env=os.environ | nowhere, capture_output=True, text=True)
    assert run.returncode != 0
    last = run.stderr.strip().splitlines()[-1]
    assert "no Vulkan device" in last and "constructskill-doctor" in last


@pytest.mark.sim
def test_an_episode_does_not_remember_the_one_before_it():
    """The expert's episode, contacts and all, twice in one environment."""
    env, episodes = ConstructSkillEnv(), []
    for _ in range(2):
        frames, success = demonstrate(env, PickPlaceExpert(ExpertConfig()), NoiseConfig(), seed=5)
        episodes.append(frames)
        assert success
    env.close()
    for first, second in zip(*episodes, strict=True):
        np.testing.assert_array_equal(first["sim.object_pose"], second["sim.object_pose"])
        np.testing.assert_array_equal(first["observation.images.base"], second["observation.images.base"])


def count_after_episodes() -> tuple[int, int]:
    """How many scenes there are after five episodes, and how many objects the garbage collector passes over."""
    env = ConstructSkillEnv(render_backend="none")
    for seed in range(5):
        env.reset(seed=seed)
        env.step(HOVER)
    names = [type(thing).__name__ for thing in gc.get_objects()]
    return names.count("ManiSkillScene"), gc.get_freeze_count()


@pytest.mark.sim
def test_a_worker_passes_over_its_imports_and_still_frees_its_scenes():
    with ProcessPoolExecutor(1, get_context("spawn")) as worker:
        scenes, spared = worker.submit(count_after_episodes).result()
    assert scenes <= 2  # this one, and the last until the next reset
    assert spared > 100_000


@pytest.mark.sim
def test_in_its_users_process_every_object_stays_collectable():
    before = gc.get_freeze_count()
    assert count_after_episodes()[1] <= before


@pytest.mark.sim
@pytest.mark.skipif(torch.cuda.is_available(), reason="needs a machine without a GPU")
def test_a_gpu_that_is_not_there_is_no_cpu_in_disguise():
    env = ConstructSkillEnv(render_backend="gpu")
    with pytest.raises(MachineError, match="render_backend must be auto or cpu on this machine"):
        env.reset(seed=0)


def test_a_suite_is_no_task_and_is_not_offered_as_one():
    with pytest.raises(InputError, match="'bins' is a suite, and one task is asked for: brick_to_bin, "):
        ConstructSkillEnv("bins")
    with pytest.raises(InputError, match="Unknown task 'brick'") as refusal:
        ConstructSkillEnv("brick")
    assert "suites" not in str(refusal.value)
    with pytest.raises(UserError, match="the suites: bins, ladder, joints"):
        ConstructSkillEnvConfig(task="brick")
