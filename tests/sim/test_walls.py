"""Walls in the simulator: sizes of their own, places that follow what lies there, and plans from files."""

import numpy as np
import pytest

from lerobot_constructskill.contract import DEMO_SEED_START, get_task
from lerobot_constructskill.demos.demonstrate import demonstrate
from lerobot_constructskill.demos.expert import ExpertConfig, Phase, PrivilegedState, make_expert
from lerobot_constructskill.demos.noise import NoiseConfig
from lerobot_constructskill.envs.gym_env import ConstructSkillEnv
from lerobot_constructskill.errors import InputError
from lerobot_constructskill.plans.plan import KINDS, written
from lerobot_constructskill.sim.contacts import FORCE_LIMIT

pytestmark = pytest.mark.sim

SEVEN = {
    "a": {"kind": "brick", "at": [-0.34, -0.22]},
    "b": {"kind": "brick", "beside": "a", "joint": 0.015},
    "c": {"kind": "brick", "on": ["a"]},
    "d": {"kind": "brick", "on": ["b"]},
    "e": {"kind": "post", "at": [-0.10, -0.42]},
    "f": {"kind": "post", "at": [0.04, -0.22]},
    "g": {"kind": "brick", "on": ["c", "d"]},
}
"""Stack bond with a brick across, and two posts: a plan that is not shipped."""

NINE = {
    "a": {"kind": "brick", "at": [-0.40, -0.25]},
    "b": {"kind": "brick", "beside": "a"},
    "c": {"kind": "brick", "beside": "b"},
    "d": {"kind": "brick", "at": [-0.40, -0.45]},
    "e": {"kind": "brick", "beside": "d"},
    "f": {"kind": "brick", "on": ["a", "b"]},
    "g": {"kind": "brick", "on": ["b", "c"]},
    "h": {"kind": "brick", "on": ["d", "e"]},
    "i": {"kind": "brick", "on": ["f", "g"]},
}
"""Two walls, of three courses and of two; two bricks wait beside the robot, and the hand goes round its base."""


def sizes_of(env, seed):
    env.reset(seed=seed)
    return PrivilegedState(**env.privileged_state()).object_sizes.reshape(-1, 3)[: len(env._env.objects)]


def test_every_episode_draws_sizes_within_the_standard_from_its_seed_alone():
    env, other = (ConstructSkillEnv("course_of_three", render_backend="none") for _ in range(2))
    drawn = {seed: sizes_of(env, seed) for seed in (1, 2, 3)}
    np.testing.assert_array_equal(sizes_of(env, 1), drawn[1])
    np.testing.assert_array_equal(sizes_of(other, 3), drawn[3])
    nominal, most = np.array(KINDS["brick"].size), np.array(KINDS["brick"].deviations)
    for sizes in drawn.values():
        assert (abs(sizes - nominal) <= most + 1e-6).all() and len(np.unique(sizes[:, 0])) == 3
    for one in (env, other):
        one.close()


def test_what_is_laid_moves_what_comes_after_and_what_is_knocked_off_is_next_again():
    import torch
    from mani_skill.utils.structs import Pose

    env = ConstructSkillEnv("course_of_three", render_backend="none")
    env.reset(seed=0)
    scene, hold = env._env, np.array([0, 0, 0, 1], np.float32)

    def put(number, place):
        pose = Pose.create_from_pq(torch.tensor([place], dtype=torch.float32), torch.tensor([[1.0, 0, 0, 0]]))
        scene.objects[number].set_pose(pose)
        for _ in range(8):
            *_, info = env.step(hold)
        return PrivilegedState(**env.privileged_state()), info

    before = PrivilegedState(**env.privileged_state())
    assert before.number == 0 and before.count == 3 and not before.is_done
    target = before.at(1).bin_position
    off = before.bin_position + [0.003, -0.002, 0]
    off[2] = before.object_size[2] / 2
    after, info = put(0, off.tolist())
    assert after.number == 1 and (info["chain"], info["placements"]) == (1, 1)
    np.testing.assert_allclose(after.bin_position[:2] - target[:2], [0.003, -0.002], atol=5e-4)
    again, info = put(0, [-0.5, 0.0, float(off[2])])
    assert again.number == 0 and (info["chain"], info["placements"], info["knocks"]) == (0, 0, 1)
    env.close()


def test_a_brick_that_lies_outside_a_fine_tolerance_is_taken_again(tmp_path):
    import torch
    from mani_skill.utils.structs import Pose

    path = tmp_path / "fine.yaml"
    path.write_text(written({"elements": {"a": {"kind": "brick", "at": [-0.34, -0.22]}}, "tolerance": 0.001}))
    task = get_task(f"plan:{path}")
    env, expert = ConstructSkillEnv(task.name, render_backend="none"), make_expert(task, ExpertConfig())
    env.reset(seed=0)
    state = PrivilegedState(**env.privileged_state())
    lies = [state.bin_position[0] + 0.004, state.bin_position[1], state.object_size[2] / 2]
    pose = Pose.create_from_pq(torch.tensor([lies], dtype=torch.float32), torch.tensor([[1.0, 0, 0, 0]]))
    env._env.objects[0].set_pose(pose)
    for _ in range(8):
        *_, info = env.step(np.array([0, 0, 0, 1], np.float32))
    advice = expert.advise(PrivilegedState(**env.privileged_state()))
    env.close()
    assert info["placements"] == 0 and advice.phase is Phase.PREGRASP and not advice.hopeless


@pytest.mark.parametrize("elements", [SEVEN, pytest.param(NINE, marks=pytest.mark.nightly)], ids=["seven", "nine"])
def test_a_plan_from_a_file_is_laid_by_the_expert(elements, tmp_path):
    path = tmp_path / "plan.yaml"
    path.write_text(written({"elements": elements}))
    task = get_task(f"plan:{path}")
    env, expert = ConstructSkillEnv(task.name, render_backend="none"), make_expert(task, ExpertConfig())
    frames, success = demonstrate(env, expert, NoiseConfig(sigma=0.0), DEMO_SEED_START)
    env.close()
    assert success and frames[-1]["sim.is_object"].sum() == len(elements)
    numbers = [int(frame["sim.placement"][0]) for frame in frames]
    assert list(dict.fromkeys(numbers)) == list(range(len(elements)))


def test_a_plan_that_cannot_be_built_is_refused_before_a_simulator_starts(tmp_path):
    path = tmp_path / "far.yaml"
    path.write_text(written({"elements": {"a": {"kind": "brick", "at": [0.9, -0.2]}}}))
    with pytest.raises(InputError, match="'a' lies .* from the robot's base"):
        ConstructSkillEnv(f"plan:{path}")


def test_forces_and_what_is_unsafe_are_told_and_an_episode_begins_anew():
    env, closing = ConstructSkillEnv("brick_to_bin", render_backend="none"), np.array([0, 0, 0, -1], np.float32)
    expert, infos = make_expert(get_task("brick_to_bin"), ExpertConfig()), []
    env.reset(seed=1)
    state = PrivilegedState(**env.privileged_state())
    assert not state.finger_forces.any() and not state.object_forces.any()
    progress = expert.start(state)
    while state.object_pose[2] < 0.2:
        action, _, progress = expert.act(state, progress)
        *_, info = env.step(action)
        state = PrivilegedState(**env.privileged_state())
    left, right = state.finger_forces.reshape(2, 3)
    weight = 9.81 * state.object_mass[0]
    assert left[1] * right[1] < 0 and abs(left[1]) > 20, "the jaws press from both sides"
    assert 0.4 * FORCE_LIMIT < state.object_forces[0] < 0.6 * FORCE_LIMIT, "the limit is twice a grasp's"
    assert -(left + right)[2] < weight * 3 and state.object_forces[0] == pytest.approx(np.linalg.norm(left), rel=0.2)
    assert (info["drops"], info["cost"]) == (0, 0) and info["peak_force"] >= state.object_forces[0]
    for _ in range(12):
        *_, info = env.step(-closing)
        infos.append(info)
    assert info["drops"] == 1 and sum(one["cost"] for one in infos) >= 1
    costs = []
    for _ in range(60):  # the hand into the ground
        *_, info = env.step(np.array([0.02, 0.05, -0.08, -1], np.float32))
        costs.append(info["cost"])
    assert info["collisions"] > 0 and max(costs) >= 1
    env.reset(seed=1)
    *_, info = env.step(closing)
    assert {name: info[name] for name in ("drops", "knocks", "collisions", "cost")} == dict.fromkeys(
        ("drops", "knocks", "collisions", "cost"), 0
    )
    env.close()
