"""Advice from the state alone: pure and sane in thousands of random states, and followed to success from disturbed
ones.

What it was when its revision was recorded is held. `PYTHONPATH=tests python tests/demos/test_advice.py` records it.
"""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from disturbances import DISTURBANCES, recover
from kinds import KINDS

from lerobot_constructskill.contract import (
    ACTION_SCALE,
    GRIPPER_CLOSED,
    GRIPPER_OPEN,
    ROBOT_BASE,
    SHIPPED,
    TASKS,
    get_task,
)
from lerobot_constructskill.demos.expert import Advice, Expert, ExpertConfig, Phase, PrivilegedState, make_expert
from lerobot_constructskill.demos.state import JAW, OPENED
from lerobot_constructskill.envs.gym_env import ConstructSkillEnv

STATES = 1000
SEED = 3_000_000
HELD = Path(__file__).with_name("advice.json")

SCENES = {
    "brick_on_brick": ([0.21, 0.065, 0.10], [0.22, 0.075, 0.04], 0.12),
    "tile_to_grid": ([0.149, 0.149, 0.06], [0.154, 0.154, 0.012], 0.106),
    "tenon_to_mortise": ([0.06, 0.05, 0.11], [0.054, 0.044, 0.04], 0.03),
    "block_to_bin": ([0.12, 0.06, 0.08], [0.30, 0.22, 0.12], 0.065),
    "brick_to_bin_3mm": ([0.21, 0.065, 0.10], [0.213, 0.068, 0.05], 0.03),
}
"""Object, receptacle and its height, where they are not the paper's."""

UNSOLVABLE = {"tipped", "dropped_on_the_way"}
"""Disturbances after which an object that lies on its side, or against the bin, may have no side that jaws take."""

TIGHT = {name for name, task in TASKS.items() if task.expert.endswith((":PreciseExpert", ":LayingExpert"))}
"""Tasks in which an object that was turned, or swings because it is held off its middle, may not fit any more, and
whose action has no rotation to set it straight."""


def random_state(task, rng) -> PrivilegedState:
    """Anything that a simulator might hold, more often than not near a grasp or a placement."""
    size, interior, height = SCENES.get(task, ([0.21, 0.065, 0.10], [0.25, 0.20, 0.15], 0.08))
    bin_position = np.array([0, -0.35, height])
    place = rng.uniform([-0.3, -0.6, size[2] / 2], [0.3, 0.3, 0.5])
    place[2] = rng.choice([size[2] / 2, place[2]])
    tilt, yaw = rng.choice([0, rng.uniform(0, np.pi)]), rng.choice([0, rng.uniform(-np.pi, np.pi)])
    if rng.random() < 0.3:
        place = bin_position + rng.normal(0, [*2 * [rng.choice([0.002, 0.05])], 0.05])
    grasp = place + [0, 0, size[2] / 2 - ExpertConfig().finger_depth]
    near = grasp + rng.normal(0, rng.choice([0.002, 0.04]), 3)
    tcp = near if rng.random() < 0.6 else rng.uniform([-0.3, -0.6, 0.01], [0.3, 0.3, 0.6])
    return PrivilegedState(
        tcp_pose=np.array([*tcp, *unit([0, 1, 0, 0] + rng.normal(0, 0.1, 4))], np.float32),
        fingers=np.full(2, rng.choice([0.0, 0.02, 0.03, 0.04]), np.float32),
        object_pose=np.array([*place, *turned(tilt, yaw)], np.float32),
        object_size=np.array(size, np.float32),
        object_mass=np.array([1.0], np.float32),
        bin_position=bin_position.astype(np.float32),
        bin_interior=np.array(interior, np.float32),
    )


def unit(values):
    return np.array(values) / np.linalg.norm(values)


def turned(tilt, yaw):
    a, b = tilt / 2, yaw / 2
    return [np.cos(b) * np.cos(a), np.cos(b) * np.sin(a), np.sin(b) * np.sin(a), np.sin(b) * np.cos(a)]


def advise(task) -> tuple[Expert, list[tuple[PrivilegedState, Advice]]]:
    """An expert, and random states with its advice."""
    expert, rng = make_expert(get_task(task), ExpertConfig()), np.random.default_rng(0)
    states = [random_state(task, rng) for _ in range(STATES)]
    return expert, [(state, expert.advise(state)) for state in states]


def total(pairs) -> list[float]:
    """The sum of all actions, and how often nothing helps: other advice in one of the states is another sum."""
    return sum(np.array([*advice.action, advice.hopeless], float) for _, advice in pairs).round(6).tolist()


@pytest.fixture(scope="module", params=TASKS)
def advised(request):
    return request.param, *advise(request.param)


def test_advice_has_not_changed(advised):
    """Rounds of DAgger are found by the revision of `demos`: those of other advice must not be taken for today's."""
    task, _, pairs = advised
    held = json.loads(HELD.read_text())
    if task not in SHIPPED:
        pytest.skip("advice is recorded for shipped tasks only")
    assert task in held, "record it: PYTHONPATH=tests python tests/demos/test_advice.py"
    np.testing.assert_allclose(total(pairs), held[task], atol=1e-3, err_msg="raise the revision of demos, and record")


def test_advice_is_a_pure_function_within_bounds(advised):
    task, expert, pairs = advised
    for state, advice in pairs:
        again = expert.advise(replace(state))
        np.testing.assert_array_equal(again.action, advice.action)
        assert (again.phase, again.hopeless) == (advice.phase, advice.hopeless)
        assert advice.action.shape == (len(get_task(task).action_names),) and advice.action.dtype == np.float32
        assert np.abs(advice.action[:-1]).max() <= ACTION_SCALE
        assert advice.action[-1] in (GRIPPER_OPEN, GRIPPER_CLOSED)
        assert not advice.hopeless or advice.phase is Phase.PREGRASP
    assert len({advice.phase for _, advice in pairs}) >= 5


def test_the_gripper_closes_on_an_object_alone(advised):
    for state, advice in advised[2]:
        if advice.action[-1] == GRIPPER_CLOSED:
            off = abs((state.object_pose[:3] - state.tcp) @ state.jaw_axis)
            assert state.is_held or (advice.phase is Phase.GRASP and off < JAW / 2)


def test_an_empty_hand_never_goes_sideways_into_the_object(advised):
    """Beside it and lower than its top, with no finger on its other side, it goes up and nowhere else."""
    seen = 0
    for state, advice in advised[2]:
        around = abs((state.object_pose[:3] - state.tcp) @ state.jaw_axis) < JAW / 2
        if state.is_held or advice.phase is Phase.RELEASE or around or state.tcp[2] > state.top:
            continue
        seen += 1
        np.testing.assert_array_equal(advice.action[:2], 0)
        assert advice.action[2] > 0 or advice.hopeless
    assert seen > STATES / 50


def test_closed_fingers_are_not_put_down_on_the_object(advised):
    for state, advice in advised[2]:
        if not state.is_held and min(state.fingers) <= OPENED and state.tcp[2] < state.top:
            assert advice.action[2] >= 0


def test_where_nothing_helps_the_hand_opens_rises_and_waits(advised):
    hopeless = [(state, advice) for state, advice in advised[2] if advice.hopeless]
    assert len(hopeless) > STATES / 20
    for state, advice in hopeless:
        assert advice.action[-1] == GRIPPER_OPEN and advice.action[2] >= 0 and not advice.action[:2].any()
        risen = replace(state, tcp_pose=np.array([*state.tcp[:2], 1.0, *state.tcp_pose[3:]]))
        assert not advised[1].advise(risen).action[:-1].any()


@pytest.mark.parametrize("off", [0.0, 0.015, 0.029])
@pytest.mark.parametrize("place", [(0.1, 0.1), (0.1, -0.1), (0.12, 0.1), (-0.1, 0.1), (0.0, 0.0)], ids=str)
@pytest.mark.parametrize("task", [name for name in TASKS if name.startswith("bri")])
def test_a_brick_held_where_the_arm_reaches_no_higher_still_comes_to_the_bin(task, place, off):
    """A hand without dynamics holds it so far outward of its middle, and goes 0.35 m for each metre it is told."""
    expert, size = make_expert(get_task(task), ExpertConfig()), np.array([0.21, 0.065, 0.10])
    _, interior, height = SCENES.get(task, (size, [0.25, 0.20, 0.15], 0.08))
    outward = np.array(place) - ROBOT_BASE[:2]
    middle = np.array([*place, size[2] / 2])
    tcp = middle + [*off * outward / np.linalg.norm(outward), size[2] / 2 - ExpertConfig().finger_depth]
    state = PrivilegedState(
        tcp_pose=np.array([*tcp, 0, 1, 0, 0]),
        fingers=np.full(2, size[1] / 2),
        object_pose=np.array([*middle, 1, 0, 0, 0]),
        object_size=size,
        object_mass=np.array([1.0]),
        bin_position=np.array([0, -0.35, height]),
        bin_interior=np.array(interior),
    )
    sag = expert._weight_compensation(state)
    for _ in range(200):
        advice = expert.advise(state)
        if advice.phase is Phase.RELEASE:
            return
        moved = np.array([*0.35 * (advice.action[:3] - sag), 0, 0, 0, 0])
        state = replace(state, tcp_pose=state.tcp_pose + moved, object_pose=state.object_pose + moved)
    pytest.fail(f"it stays at {state.tcp} in {advice.phase}")


@pytest.mark.sim
@pytest.mark.slow
@pytest.mark.parametrize("task", KINDS)
def test_the_advice_is_followed_to_success_from_disturbed_states(task):
    env, expert = ConstructSkillEnv(task, render_backend="none"), make_expert(get_task(task), ExpertConfig())
    some = list(DISTURBANCES)[list(TASKS).index(task) % 3 :: 3]  # tasks share experts: each is tried with all
    outcomes = {name: recover(env, expert, DISTURBANCES[name], SEED) for name in some}
    env.close()
    lost = {name for name, (success, _, hopeless) in outcomes.items() if not success}
    assert lost <= UNSOLVABLE | ({"turned", "off_centre"} if task in TIGHT else set())
    assert task in TIGHT or all(outcomes[name][2] for name in lost), "lost, and not said to be hopeless"


if __name__ == "__main__":
    held = {task: total(advise(task)[1]) for task in SHIPPED}
    HELD.write_text(json.dumps(held, indent=1) + "\n")
