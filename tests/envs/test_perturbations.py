"""Every axis does what it says and nothing else, the same every time, and leaves the task alone at level 0."""

from contextlib import nullcontext

import numpy as np
import pytest

from lerobot_constructskill.board.protocol import BoardSetting
from lerobot_constructskill.contract import TASKS
from lerobot_constructskill.envs.configuration_constructskill import ConstructSkillEnvConfig
from lerobot_constructskill.envs.gym_env import ConstructSkillEnv
from lerobot_constructskill.errors import InputError, UserError
from lerobot_constructskill.perturbations import AXES, Perturbation

SEEN = set(AXES) - {"size"}
"""Axes that show in the first picture by a margin; a brick some millimetres larger hardly does."""

PHYSICAL = {"size", "pose"}
"""Axes that change the state the expert sees at the start."""


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


@pytest.mark.sim
@pytest.mark.parametrize("axis", AXES)
def test_an_axis_changes_what_it_says(axis, nominal):
    picture, state = start(perturb=f"{axis}={len(AXES[axis].levels)}")
    assert (abs(picture - nominal[0]).sum(-1) > 10).any() or axis not in SEEN
    assert (np.abs(state - nominal[1]).max() > 1e-4) == (axis in PHYSICAL)


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
