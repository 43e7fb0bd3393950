"""Every axis does what it says and nothing else, the same every time, and leaves the task alone at level 0."""

import sys
from contextlib import nullcontext
from dataclasses import replace
from functools import lru_cache
from pathlib import Path

import numpy as np
import pytest
import torch

from lerobot_constructskill.board.protocol import BoardSetting
from lerobot_constructskill.contract import SUITES, TASKS, get_task
from lerobot_constructskill.envs.configuration_constructskill import ConstructSkillEnvConfig
from lerobot_constructskill.envs.gym_env import ConstructSkillEnv
from lerobot_constructskill.errors import InputError, UserError
from lerobot_constructskill.perturbations import AXES, BODIES, Perturbation

BENCHMARKS = Path(__file__).parents[2] / "benchmarks"
sys.path.insert(0, str(BENCHMARKS))
from axes import (  # noqa: E402
    GRASPED,
    PAGE,
    Difference,
    cells,
    complaints,
    grasping,
    levels,
    replay,
    seed_of,
    sentences,
)

TASK = "brick_to_bin"
OTHERS = [names[-1] for names in SUITES.values() if TASK not in names]
CHANGED, SAID = PAGE.read_text(encoding="utf-8").split("\n\nHow many")
TOLD = {row.split("`")[1]: row for row in SAID.splitlines() if row.startswith("| `")}
"""The page's row of each task that it covers."""


def highest(axis):
    return len(AXES[axis].levels)


def row_of(task, axis, level):
    """The page's only row of this level that covers the task."""
    rows = [row for row in CHANGED.splitlines() if row.startswith(f"| `{axis}` | {level} |")]
    (row,) = (row for row in rows if row.endswith("| all |") or f"`{task}`" in row.rsplit("|", 2)[1])
    return row


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


@lru_cache(1)
def usual(task, steps=GRASPED):
    """The expert's actions until it has the object in the jaws, at most so many, and the episode."""
    actions = grasping(task, steps)
    return actions, replay(actions, task)


def certified(task, axis, level, steps=GRASPED):
    """What a level changes: what is said and nothing else. Were it anything else, it would be found."""
    actions, nominal = usual(task, steps)
    seen = Difference.between(nominal, replay(actions, task, f"{axis}={level}", seed_of(task, axis, level)))
    assert list(complaints(axis, seen)) == []
    leaks = replace(seen, said="" if seen.said else "another"), replace(seen, at_start={*BODIES}, later={*BODIES})
    assert all([*complaints(axis, leak)] for leak in leaks)
    return seen


@pytest.mark.sim
@pytest.mark.parametrize(
    ("task", "axis", "level"),
    [
        pytest.param(task, axis, level, marks=[pytest.mark.nightly] * (task != TASK or level < highest(axis)))
        for task in TASKS
        for axis, level in levels(task)
    ],
)
def test_an_axis_changes_what_it_says_and_nothing_else_and_the_page_says_the_same(task, axis, level):
    seen = certified(task, axis, level)
    if task in TOLD:
        assert row_of(task, axis, level).startswith(cells(axis, level, seen)) and seen.said in TOLD[task]
        assert TOLD[task].startswith(f"| `{task}` | {len(usual(task)[0])} |")


@pytest.mark.sim
@pytest.mark.parametrize(
    ("task", "axis"), [(task, axis) for task in OTHERS for axis, level in levels(task) if level == highest(axis)]
)
def test_so_it_does_in_the_first_steps_of_a_task_of_every_other_suite(task, axis):
    certified(task, axis, highest(axis), steps=6)


@pytest.mark.parametrize("task", TOLD)
def test_the_page_of_what_axes_change_has_every_level_once_and_every_sentence(task):
    for axis, level in levels(task):
        row, changes = row_of(task, axis, level), AXES[axis].changes
        said = "another" if "instruction" in changes else ""
        equal = cells(axis, level, Difference(set(), set(), {}, {}, said))
        moves = {"execution", *BODIES} & {*changes}
        assert row.startswith(equal.rsplit("equal | equal", 1)[0] if moves else equal)
    changing = [one for one in levels(task) if "instruction" in AXES[one[0]].changes]
    said = [Perturbation(f"{axis}={level}").told(get_task(task)).instruction for axis, level in changing]
    actions = TOLD[task].split(" | ")[1]
    assert TOLD[task].startswith(sentences(task, actions, get_task(task).instruction, said))


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
