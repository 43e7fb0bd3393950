"""What every registered task owes, checked on the real simulator and renderer."""

import json
import subprocess
import sys
from importlib import import_module
from zipfile import BadZipFile

import gymnasium as gym
import numpy as np
import pytest
import torch
from kinds import KINDS
from mani_skill.envs.utils.randomization.batched_rng import BatchedRNG
from mani_skill.utils.geometry.rotation_conversions import axis_angle_to_quaternion, quaternion_multiply
from mani_skill.utils.structs import Pose

import lerobot_constructskill.sim.register  # noqa: F401
from lerobot_constructskill.contract import IMAGE_SIZE, JOINTS, LADDER, SIM_STATE, TASKS
from lerobot_constructskill.errors import InputError, UserError
from lerobot_constructskill.perturbations import Perturbation
from lerobot_constructskill.sim import backends, scene
from lerobot_constructskill.sim.actions import Hold
from lerobot_constructskill.sim.backends import best_render_backend
from lerobot_constructskill.sim.scene import PLACED_STEPS, PickPlaceEnv
from lerobot_constructskill.sim.tasks.block import BlockToBinEnv
from lerobot_constructskill.sim.tasks.brick import TOLERANCE

pytestmark = pytest.mark.sim

HOLD_OPEN = np.array([0, 0, 0, 0, 0, 0, 1], dtype=np.float32)
HOLD_CLOSED = np.array([0, 0, 0, 0, 0, 0, -1], dtype=np.float32)


def make(task, **kwargs):
    kwargs = {"obs_mode": "none", "render_backend": "none"} | kwargs
    return gym.make(TASKS[task].env_id, **kwargs).unwrapped


@pytest.fixture(scope="module", params=KINDS)
def blind(request):
    """An environment of each task that renders nothing."""
    env = make(request.param)
    yield env
    env.close()


@pytest.fixture(scope="module", params=KINDS)
def seeing(request):
    env = make(request.param, obs_mode="rgb", render_backend="auto", cameras=("base", "wrist"))
    yield env
    env.close()


WITHOUT_A_GPU = pytest.mark.skipif(torch.cuda.is_available(), reason="a GPU can")


@pytest.mark.parametrize(
    "asked, said",
    [
        ({"obs_mode": "state"}, None),
        ({"obs_mode": "state_dict"}, None),
        ({"obs_mode": "rgb"}, None),
        ({"obs_mode": "rgb", "cameras": ("base", "wrist")}, None),
        ({"obs_mode": "depth+segmentation"}, None),
        ({"obs_mode": "pictures"}, "Invalid texture type 'pictures'"),
        ({"reward_mode": "sparse"}, None),
        ({"reward_mode": "none"}, None),
        ({"reward_mode": "dense"}, "reward_mode must be sparse .* not 'dense'"),
        ({"reward_mode": "normalized_dense"}, "reward_mode must be sparse"),
        ({"control_mode": "pd_joint_delta_pos"}, None),
        ({"control_mode": "pd_ee_delta_pos"}, None),
        ({"control_mode": "metres"}, "metres not in supported modes: .*pd_ee_delta_pose"),
        ({"robot_uids": "panda"}, None),
        ({"render_mode": "rgb_array"}, None),
        pytest.param({"num_envs": 4}, "need a GPU, and there is none", marks=WITHOUT_A_GPU),
        pytest.param({"sim_backend": "gpu"}, "need a GPU, and there is none", marks=WITHOUT_A_GPU),
        pytest.param({"render_mode": "human"}, "render_mode=human needs a display", marks=WITHOUT_A_GPU),
    ],
    ids=str,
)
def test_what_maniskills_users_ask_for_works_or_is_refused_in_one_sentence(asked, said):
    def use():
        env = gym.make(TASKS["brick_to_bin_turned"].env_id, **asked)
        try:
            seen, _ = env.reset(seed=0)
            assert torch.is_tensor(seen) == (asked.get("obs_mode", "state") == "state")
            _, reward, *_ = env.step(env.action_space.sample())
            assert env.render_mode is None or env.render().shape[-1] == 3
            return reward
        finally:
            env.close()

    if said is None:
        assert use() == 0
        return
    with pytest.raises(UserError, match=said) as refused:
        use()
    assert "\n" not in str(refused.value)


def trajectory(env, seed, steps=12):
    rng = np.random.default_rng(seed)
    env.reset(seed=seed, options={"reconfigure": True})  # as ours do: PhysX would keep the last episode's contacts
    states = []
    for _ in range(steps):
        env.step(rng.uniform(-1, 1, 7).astype(np.float32))
        states.append(torch.cat(list(env.privileged_state().values()), dim=-1))
    return torch.cat(states)


def move_object(env, position, number=0):
    moved = env.objects[number]
    moved.set_pose(Pose.create_from_pq(torch.tensor([position]), torch.tensor([[1.0, 0, 0, 0]])))
    moved.set_linear_velocity(torch.zeros(3))
    moved.set_angular_velocity(torch.zeros(3))


def place_all(env):
    """Set every object down where it comes to rest in its receptacle."""
    listed = {name: value[0] for name, value in env.privileged_state().items()}
    for number, (place, interior, size) in enumerate(
        zip(*(listed[name].reshape(-1, 3) for name in ("bin_positions", "bin_interiors", "object_sizes")), strict=True)
    ):
        if listed["is_object"][number]:
            height = place[2] - interior[2] / 2 + size[2] / 2
            move_object(env, [float(place[0]), float(place[1]), float(height)], number)


def test_every_camera_shows_a_picture_and_the_objects_in_it(seeing):
    obs, _ = seeing.reset(seed=0)
    for camera in ("base", "wrist"):
        rgb = obs["sensor_data"][camera]["rgb"]
        assert rgb.shape == (1, IMAGE_SIZE, IMAGE_SIZE, 3) and rgb.dtype == torch.uint8
        assert rgb.float().std() > 10
    with_object = obs["sensor_data"]["base"]["rgb"].int()
    move_object(seeing, [-2.0, -2.0, 0.1])
    without = seeing.get_obs()["sensor_data"]["base"]["rgb"].int()
    assert ((with_object - without).abs().sum(-1) > 30).sum() > 20


def test_equal_seeds_and_actions_give_equal_trajectories(blind):
    first = trajectory(blind, seed=5)
    trajectory(blind, seed=6)
    assert torch.equal(first, trajectory(blind, seed=5))
    assert torch.isfinite(first).all()


def test_mixed_precision_around_a_simulator_changes_nothing():
    """As in `lerobot-eval --policy.use_amp=true` with one environment, which is in the process of the policy."""
    env = make("brick_to_bin_turned")
    alone = trajectory(env, seed=5)
    with torch.autocast("cpu", dtype=torch.bfloat16):
        assert torch.equal(trajectory(env, seed=5), alone)
        agent = env.agent_state()
    assert torch.equal(env.agent_state(), agent)
    env.close()


def test_initial_states_vary_exactly_where_the_task_says_so(blind):
    poses = []
    for seed in range(8):
        blind.reset(seed=seed)
        poses.append(blind.object.pose.p[0].numpy().copy())
    starts = np.array([start for start, _ in blind.ways])
    away = np.array(poses)[:, None, :2] - starts
    offsets = away[np.arange(8), np.linalg.norm(away, axis=-1).argmin(axis=1)]
    assert np.abs(offsets).max() <= blind.spawn_range + 1e-6
    assert (np.ptp(offsets, axis=0) > blind.spawn_range / 2).all() or blind.spawn_range == 0


def test_the_object_is_set_down_where_and_as_turned_as_was_drawn():
    env = make("brick_to_bin")
    env.spawn_range, env.yaw_range = PickPlaceEnv.spawn_range, PickPlaceEnv.yaw_range
    for seed in range(4):
        env.reset(seed=seed)
        dx, dy, dyaw = env._spawn_offsets(BatchedRNG.from_seeds([seed], backend="numpy:random_state"))[0]
        w, x, y, z = env.object.pose.q[0].numpy()
        expected = [*(np.array(env.object_center) + [dx, dy]), env.object_size[2] / 2]
        np.testing.assert_allclose(env.object.pose.p[0].numpy(), expected, atol=1e-6)
        assert (x, y) == (0, 0) and np.isclose(np.arctan2(z, w) * 2, dyaw, atol=1e-5)


BATCH = """
import json
import gymnasium as gym
import lerobot_constructskill.sim.register
from lerobot_constructskill.contract import TASKS
env = gym.make(TASKS["block_to_bin"].env_id, obs_mode="none", render_backend="none", num_envs=3).unwrapped
env.reset(seed=[3, 4, 5])
print(json.dumps(env.object.pose.p[1].tolist()))
"""


def test_an_episode_starts_alike_alone_and_in_a_batch_on_the_gpu():
    """In a process of its own: PhysX can only be had on a GPU before any scene on the CPU."""
    if best_render_backend() != "gpu":
        pytest.skip("several environments in one simulator need a GPU")
    done = subprocess.run([sys.executable, "-c", BATCH], capture_output=True, text=True)
    if "library for it cannot be loaded" in done.stderr:
        pytest.skip("PhysX for the GPU cannot be had here")
    assert done.returncode == 0, done.stderr
    alone = make("block_to_bin")
    alone.reset(seed=4)
    np.testing.assert_allclose(json.loads(done.stdout.splitlines()[-1]), alone.object.pose.p[0], atol=1e-6)


@pytest.mark.parametrize(
    ("render_backend", "error", "said"),
    [
        ("gpu", ConnectionError("no route"), r"library for it cannot be loaded \(no route\)"),
        ("gpu", OSError("libcuda.so: cannot open"), r"library for it cannot be loaded \(libcuda.so"),
        ("none", BadZipFile("File is not a zip file"), r"library for it cannot be loaded \(File is not"),
        ("none", RuntimeError("GPU PhysX can only be enabled once"), "must be the first simulator of a process"),
        ("cpu", None, "that renders them too: use render_backend=gpu or none"),
    ],
)
def test_gpu_physics_that_cannot_be_had_is_refused_in_one_sentence(render_backend, error, said, monkeypatch):
    def enable_gpu():
        raise error

    monkeypatch.setattr(backends.sapien, "Device", lambda name: name)
    monkeypatch.setattr(backends.physx, "enable_gpu", enable_gpu)
    monkeypatch.setattr(scene, "best_render_backend", lambda: "gpu")
    with pytest.raises(UserError, match=f"^Several environments .* need a GPU.* {said}") as told:
        make("block_to_bin", num_envs=2, render_backend=render_backend)
    assert "\n" not in str(told.value)


def test_an_episodes_draw_does_not_depend_on_its_batch():
    draw = PickPlaceEnv._spawn_offsets
    batch = draw(PickPlaceEnv, BatchedRNG.from_seeds([3, 4, 5], backend="numpy:random_state"))
    alone = draw(PickPlaceEnv, BatchedRNG.from_seeds([4], backend="numpy:random_state"))
    np.testing.assert_array_equal(batch[1:2], alone)


def test_the_shared_class_randomises_position_and_a_full_turn_of_yaw():
    rng = BatchedRNG.from_seeds(list(range(400)), backend="numpy:random_state")
    offsets = PickPlaceEnv._spawn_offsets(PickPlaceEnv, rng)
    np.testing.assert_allclose(np.abs(offsets).max(axis=0), [0.10, 0.10, np.pi], rtol=0.05)
    np.testing.assert_allclose(offsets.mean(axis=0), 0, atol=0.25)


def test_the_papers_bounds_follow_from_the_bins_geometry():
    env = make("brick_to_bin")
    assert env.placement_bounds == pytest.approx((0.125, 0.10, 0.10))
    assert env.object_size == (0.21, 0.065, 0.10)


def test_placement_takes_five_consecutive_steps_with_the_gripper_open(blind):
    blind.reset(seed=0)
    place_all(blind)
    for _ in range(4):
        *_, info = blind.step(HOLD_OPEN)
        assert info["is_in_bin"] and info["is_gripper_open"] and not info["success"]
    move_object(blind, [0.3, 0.0, blind.object_size[2] / 2])
    *_, info = blind.step(HOLD_OPEN)
    assert not info["is_in_bin"] and not info["success"]
    place_all(blind)
    done = [bool(blind.step(HOLD_OPEN)[-1]["success"]) for _ in range(12)]
    leans = len(blind.objects) > 1  # what stands on two others of different height settles first
    assert done[-1] and (done.index(True) == PLACED_STEPS - 1 or (leans and done.index(True) >= PLACED_STEPS))


def test_a_closed_gripper_is_no_placement(blind):
    blind.reset(seed=0)
    for _ in range(PLACED_STEPS):
        blind.step(HOLD_CLOSED)
    place_all(blind)
    for _ in range(2 * PLACED_STEPS):
        *_, info = blind.step(HOLD_CLOSED)
    assert info["is_in_bin"] and not info["is_gripper_open"] and not info["success"]


def test_asking_twice_changes_no_outcome(blind):
    blind.reset(seed=0)
    place_all(blind)
    for _ in range(PLACED_STEPS - 1):
        blind.step(HOLD_OPEN)
        first, second = blind.evaluate(), blind.evaluate()
        assert all(torch.equal(first[name], second[name]) for name in first)
    assert not first["success"]


def test_lifted_is_a_centre_at_15_cm_and_open_both_fingers_at_38_mm(blind):
    """Paper, section III."""
    blind.reset(seed=0)
    for height, lifted in ((0.149, False), (0.151, True)):
        move_object(blind, [0.3, 0.3, height])
        assert blind.evaluate()["is_lifted"].item() == lifted
    for fingers, is_open in (((0.0375, 0.04), False), ((0.04, 0.0375), False), ((0.0385, 0.0385), True)):
        qpos = blind.agent.robot.get_qpos()
        qpos[:, -2:] = torch.tensor(fingers)
        blind.agent.robot.set_qpos(qpos)
        assert blind.evaluate()["is_gripper_open"].item() == is_open


def test_a_new_task_is_an_asset_four_constants_and_its_initial_states():
    """Spec, section 1: the promise that other construction tasks are cheap, held on the one that was added for it."""
    constants = {"object_size", "object_center", "bin_center", "bin_interior"}
    own = {name for name in vars(BlockToBinEnv) if not name.startswith("__")}
    assert own <= constants | {"_load_object", "spawn_range", "yaw_range"} and "__init__" not in vars(BlockToBinEnv)


def test_lifted_holds_for_the_rest_of_the_episode_and_not_for_the_next(blind):
    blind.reset(seed=0)
    move_object(blind, [0.3, 0.3, 0.4])
    _, reward, *_ = blind.step(HOLD_OPEN)
    move_object(blind, [0.3, 0.3, 0.05])
    *_, info = blind.step(HOLD_OPEN)
    assert info["is_lifted"] and reward.shape == (1,)
    _, info = blind.reset(seed=0)
    assert not info["is_lifted"]


@pytest.mark.parametrize("task, clearance", LADDER.items())
def test_a_rung_of_the_ladder_has_its_clearance_and_the_fingers_open_above_its_rim(task, clearance):
    env = make(task)
    np.testing.assert_allclose(np.subtract(env.bin_interior, env.object_size)[:2], clearance)
    tips = env.rest_position[2] + env.object_size[2] / 2 - 0.039
    assert tips > env.bin_position[2] + env.bin_interior[2] / 2
    env.close()


@pytest.mark.parametrize("task", TASKS.values(), ids=TASKS)
def test_the_row_says_whether_the_scene_has_a_brick(task):
    module, name = task.scene.split(":")
    assert getattr(import_module(module), name).is_brick == task.is_brick


def test_bricks_of_another_size_have_to_be_as_flush_as_any():
    for seed in range(3):
        env = make("brick_on_brick", perturbation=Perturbation("size=2", seed))
        assert env.object_size != type(env).object_size and env.bin_floor == env.object_size[2]
        np.testing.assert_allclose(env.play, TOLERANCE)
        env.close()


def test_a_brick_too_large_for_its_bin_is_refused_of_maniskills_users_too():
    with pytest.raises(InputError, match="too large for the bin, 5 mm larger than"):
        make("brick_to_bin_5mm", perturbation=Perturbation("size=2"))


def test_a_pose_is_drawn_anew_by_every_reset_and_by_its_seed_where_it_has_one():
    env, drawn = make("brick_to_bin", perturbation=Perturbation("pose=3")), []
    for seed in (5, None, None, 5, None):
        env.reset(seed=seed)
        drawn.append(tuple(env.agent.robot.get_qpos()[0, :7].tolist()))
    assert drawn[3:] == drawn[:2] and len(set(drawn)) == 3
    env.close()


def test_a_brick_that_leans_on_the_rim_is_placed_as_the_paper_counts_and_not_strictly():
    env = make("brick_to_bin_40mm")
    env.reset(seed=0)
    for _ in range(PLACED_STEPS):
        x, y, z = env.rest_position
        env.object.set_pose(
            Pose.create_from_pq(torch.tensor([[x, y, z + 0.022]]), torch.tensor([[0.995, 0, 0.0998, 0]]))
        )
        *_, info = env.step(HOLD_OPEN)
    assert info["is_placed"] and not info["is_upright"] and not info["success"]
    env.close()


def test_a_held_hand_stays_level_under_the_brick_and_keeps_the_yaw_it_was_given():
    hand = torch.tensor([[0.02, 0.98, 0.17, 0.03]])
    hand /= hand.norm()
    action = torch.tensor([0.1, 0.2, 0.3, 9.0, 9.0, 0.7, 1.0])
    turning, fixed = Hold(yaw=False), Hold(yaw=True)
    assert turning.apply(action, hand)[[0, 1, 2, 5, 6]].tolist() == action[[0, 1, 2, 5, 6]].tolist()
    assert abs(float(turning.correction(hand)[0, 2])) < 0.01 < abs(float(fixed.correction(hand)[0, 2]))
    level = quaternion_multiply(axis_angle_to_quaternion(turning.correction(hand)), hand)
    torch.testing.assert_close(level[:, [0, 3]], torch.zeros(1, 2), atol=2e-3, rtol=0)


def test_a_hand_that_is_driven_by_its_joints_is_not_held():
    """Their numbers stand where other actions have rotations."""
    env = make("brick_to_bin_10mm", control_mode="pd_joint_pos")
    env.reset(seed=0)
    joints = env.agent.robot.get_qpos()[0]
    for _ in range(20):
        env.step(np.append(joints[:7], 1.0))
    torch.testing.assert_close(env.agent.robot.get_qpos()[0, :7], joints[:7], atol=0.02, rtol=0)
    env.step(None)
    env.close()


def test_privileged_state_is_what_the_contract_says(blind):
    blind.reset(seed=0)
    state = blind.privileged_state()
    assert {name: value.shape for name, value in state.items()} == {
        name: (1, len(channels)) for name, channels in SIM_STATE.items()
    }


def test_joints_are_in_the_order_of_their_names_and_velocities_are_the_positions_changes(blind):
    blind.reset(seed=0)
    assert tuple(joint.name for joint in blind.agent.robot.active_joints) == JOINTS
    for direction in (0.3, -0.3):
        before = blind.privileged_state()["joint_positions"][0, :7].clone()
        blind.step(np.array([direction, 0, 0, 0, 0, 0, 1], np.float32))
        after, velocity = (blind.privileged_state()[name][0, :7] for name in ("joint_positions", "joint_velocities"))
        moves = (after - before).abs() > 0.005
        assert moves.any() and (torch.sign(velocity) == torch.sign(after - before))[moves].all()


def test_the_light_robot_moves_as_the_original_to_the_last_bit(blind):
    """Or an episode that was driven with pictures would not be the one that is replayed without."""
    (task,) = (name for name, row in TASKS.items() if row.env_id == blind.spec.id)
    light = make(task, light_robot=True)
    assert torch.equal(trajectory(light, seed=1, steps=30), trajectory(blind, seed=1, steps=30))
    light.close()


def test_the_light_robot_looks_like_the_original():
    frames = []
    for light_robot in (True, False):
        env = make("brick_to_bin", obs_mode="rgb", render_backend="auto", light_robot=light_robot)
        env.reset(seed=1)
        frames.append(env.get_obs()["sensor_data"]["base"]["rgb"].float())
        env.close()
    assert (frames[0] - frames[1]).abs().mean() < 1.0
