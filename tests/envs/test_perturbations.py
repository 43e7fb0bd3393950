"""Every axis does what it says and nothing else, the same every time, and leaves the task alone at level 0."""

import re
import sys
from contextlib import nullcontext
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from lerobot_constructskill.board.protocol import BoardSetting
from lerobot_constructskill.contract import TASKS, get_task
from lerobot_constructskill.demos.demonstrate import demonstrate
from lerobot_constructskill.demos.expert import ExpertConfig, make_expert
from lerobot_constructskill.demos.noise import NoiseConfig
from lerobot_constructskill.envs.configuration_constructskill import ConstructSkillEnvConfig
from lerobot_constructskill.envs.gym_env import ConstructSkillEnv
from lerobot_constructskill.errors import InputError, UserError
from lerobot_constructskill.perturbations import AXES, BODIES, Perturbation

BENCHMARKS = Path(__file__).parents[2] / "benchmarks"
sys.path.insert(0, str(BENCHMARKS))
from axes import Difference, complaints, replay  # noqa: E402

TASK = get_task("brick_to_bin")
LEVELS = [(axis, level) for axis, of in AXES.items() for level in range(1, len(of.levels) + 1)]


def start(seed=0, **kwargs):
    """First picture, and privileged state, of an episode of the paper's task."""
    env = ConstructSkillEnv("brick_to_bin", **kwargs)
    obs, _ = env.reset(seed=seed)
    state = np.concatenate(list(env.privileged_state().values()))
    env.close()
    return obs["pixels"]["base"].astype(int), state


@pytest.fixture(scope="module")
def nominal():
    return start()


@pytest.fixture(scope="module")
def grasped():
    """The expert's actions until it has the brick in the jaws, and the episode."""
    env, expert = ConstructSkillEnv("brick_to_bin", render_backend="none"), make_expert(TASK, ExpertConfig())
    frames, _ = demonstrate(env, expert, NoiseConfig(sigma=0.0), 0)
    env.close()
    actions = [frame["action"] for frame in frames if frame["phase"] in ("PREGRASP", "DESCEND", "GRASP")]
    return actions, replay(actions, task=TASK.name)


@pytest.mark.sim
@pytest.mark.parametrize("axis", AXES)
def test_an_axis_changes_what_it_says_and_nothing_else(axis, grasped):
    """Of every level, and beyond the grasp: `python benchmarks/axes.py`."""
    actions, nominal = grasped
    seen = Difference.between(nominal, replay(actions, f"{axis}={len(AXES[axis].levels)}", TASK.name))
    assert list(complaints(axis, seen)) == []
    leaks = replace(seen, instruction=not seen.instruction), replace(seen, at_start={*BODIES}, later={*BODIES})
    assert all([*complaints(axis, leak)] for leak in leaks)


def test_the_page_of_what_axes_change_has_every_level():
    page = (BENCHMARKS / "AXES.md").read_text(encoding="utf-8")
    assert re.findall(r"^\| `(\w+)` \| (\d) \|", page, re.MULTILINE) == [(axis, str(level)) for axis, level in LEVELS]


@pytest.mark.sim
def test_late_actions_come_whole_and_in_order_and_until_then_the_hand_stays_open():
    from lerobot_constructskill.sim.actions import Delay

    delay = Delay(2, torch.device("cpu"), 2)
    given = torch.rand(4, 2, 7)
    due = torch.stack([delay.apply(action) for action in given])
    assert torch.equal(due[2:], given[:2]) and (due[:2] == torch.tensor([0.0] * 6 + [1.0])).all()
    delay.forget(torch.tensor([1]))
    last = delay.apply(given[0])
    assert torch.equal(last[0], given[2, 0]) and last[1].tolist() == [0.0] * 6 + [1.0]


@pytest.mark.sim
def test_latency_executes_the_same_actions_later_to_the_last_bit():
    def reached(actions, **kwargs):
        env = ConstructSkillEnv("brick_on_brick", render_backend="none", **kwargs)
        env.reset(seed=1)
        for action in actions:
            env.step(action)
        state = env.privileged_state()["joint_positions"]
        env.close()
        return state

    moves = np.random.default_rng(0).uniform(-0.02, 0.02, (6, 4)).astype(np.float32)
    still = np.array([[0, 0, 0, 1]] * 2, np.float32)
    late = reached([*moves, *still], perturb="latency=2")
    np.testing.assert_array_equal(late, reached([*still, *moves]))
    assert (late != reached([*moves, *still])).any()


@pytest.mark.sim
def test_latency_is_of_one_control_mode():
    from lerobot_constructskill.sim.scene import PickPlaceEnv

    with pytest.raises(InputError, match="delays actions of pd_ee_delta_pose, not of pd_joint_pos"):
        PickPlaceEnv(control_mode="pd_joint_pos", perturbation=Perturbation("latency=1"))


@pytest.mark.sim
def test_equal_levels_and_seeds_give_equal_scenes_and_another_seed_another():
    levels = ",".join(f"{axis}=1" for axis in AXES)
    (picture, state), (again, same) = start(perturb=levels), start(perturb=levels)
    np.testing.assert_array_equal(picture, again)
    np.testing.assert_array_equal(state, same)
    other_picture, other_state = start(perturb=levels, perturb_seed=1)
    assert (other_picture != picture).any() and (other_state != state).any()


@pytest.mark.sim
def test_level_zero_is_the_task_as_it_is(nominal):
    picture, state = start(perturb=",".join(f"{axis}=0" for axis in AXES), perturb_seed=5)
    np.testing.assert_array_equal(picture, nominal[0])
    np.testing.assert_array_equal(state, nominal[1])


@pytest.mark.sim
def test_bricks_stay_within_the_standards_tolerance():
    """Category T1 allows 4 mm of a face of 100 mm and 5.8 mm of one of 210 mm."""
    for seed in range(6):
        env = ConstructSkillEnv("brick_to_bin", render_backend="none", perturb="size=2", perturb_seed=seed)
        env.reset(seed=0)
        deviation = np.abs(env.privileged_state()["object_size"] - [0.21, 0.065, 0.10])
        env.close()
        assert (deviation <= [0.0058, 0.0033, 0.0041]).all() and deviation.max() > 1e-4


def test_a_brick_too_large_for_its_bin_is_refused():
    """No policy could place it; of the default draw at level 2 docs/tasks.md says so for 5 and 3 mm."""
    for task, fits in (("brick_to_bin_10mm", True), ("brick_to_bin_5mm", False), ("brick_to_bin_3mm", False)):
        with nullcontext() if fits else pytest.raises(InputError, match=r"too large for the bin, [53] mm larger than"):
            ConstructSkillEnv(task, render_backend="none", perturb="size=2")


@pytest.mark.parametrize("task", [name for name, task in TASKS.items() if not task.is_brick])
def test_a_task_without_a_brick_has_no_brick_size(task):
    for what in (ConstructSkillEnv, ConstructSkillEnvConfig, BoardSetting):
        with pytest.raises(UserError, match=f"EN 771-1.*{task} has no brick"):
            what(task=task, perturb="size=1")
        what(task=task, perturb="size=0,light=1")


@pytest.mark.parametrize(
    "bad, word",
    [("colour=1", "camera"), ("camera=4", "0 to 3"), ("camera", "0 to 3"), (f"camera={'0' * 5000}", "0 to 3")],
    ids=["axis", "level", "no level", "many digits"],
)
def test_levels_that_do_not_exist_are_refused(bad, word):
    with pytest.raises(UserError, match=word):
        ConstructSkillEnvConfig(perturb=bad)


def test_results_are_kept_under_the_perturbations_name():
    config = ConstructSkillEnvConfig(task="joints", perturb="camera=2,light=0,sensor=1", perturb_seed=3)
    assert list(config.create_envs(n_envs=1)) == ["joints+camera=2+sensor=1+seed=3"]
    assert Perturbation("light=0").label == Perturbation("light=00").label == ""
    assert Perturbation(" light=1, camera=02").label == Perturbation("camera=2,light=1").label
