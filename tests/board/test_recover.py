"""The point of no return, of episodes in which it is known by construction, and of a board's by the command."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pyarrow.parquet as pq
import pytest
from commands import call

from lerobot_constructskill.board.recover import recover_episode
from lerobot_constructskill.board.recovered import FAILED, Lost, Recovery
from lerobot_constructskill.board.replay import open_simulator, open_workers
from lerobot_constructskill.board.submission import Claim, read_submission, write_submission
from lerobot_constructskill.contract import GRIPPER_OPEN, ROBOT_BASE, get_task
from lerobot_constructskill.demos.expert import ExpertConfig, PrivilegedState, make_expert
from lerobot_constructskill.envs import gym_env
from lerobot_constructskill.envs.recording import Episode

pytestmark = [pytest.mark.sim, pytest.mark.slow]

ENTRIES = Path(__file__).parents[2] / "board" / "entries"
TASK, START, STEPS, PUSH = "brick_to_bin_shifted", 5017, 140, 40
STILL = np.array([0, 0, 0, GRIPPER_OPEN], np.float32)
PUSHING = STILL + np.array([0.0123, 0, 0, 0], np.float32)
"""The action that pushes the object out of reach in a `Pushed`."""


class Pushed(gym_env.ConstructSkillEnv):
    """An environment in which an action that no expert takes puts the object beside the robot's foot."""

    def step(self, action):
        if np.array_equal(action, PUSHING):
            import sapien

            self.started().object.set_pose(sapien.Pose([ROBOT_BASE[0], 0.2, 0.05]))
        return super().step(action)


def executed(env, act) -> Claim:
    """An episode in which `act(step, state)` acts, as a claim that is true."""
    env.reset(seed=START)
    episode, is_over = Episode(START, task=TASK, episode_length=STEPS), False
    while not is_over:
        action = act(episode.steps, PrivilegedState(**env.privileged_state()))
        _, _, terminated, truncated, info = env.step(action)
        episode.add(action, info)
        is_over = terminated or truncated
    return Claim(**vars(episode) | {"setting": TASK})


def found_after_a_push() -> tuple[Recovery, Recovery, Recovery]:
    """Of an episode that stands still but for the push: twice, and of one that claims to be longer than it is."""
    env = Pushed(TASK, episode_length=STEPS, render_backend="none")
    claim = executed(env, lambda step, state: PUSHING if step + 1 == PUSH else STILL)
    wrong = replace(claim, steps=claim.steps - 1)
    return *(recover_episode(env, claim, drawn) for drawn in (False, True)), recover_episode(env, wrong)


def found_after_a_release() -> tuple[Recovery, int]:
    """Of an episode in which the expert carries the object over the bin's rim, where the jaws open and rise, and when.

    They would close on it again if they stayed.
    """
    env = open_simulator({"task": TASK, "episode_length": STEPS})
    expert, opened = make_expert(get_task(TASK), ExpertConfig()), []

    def act(step, state):
        rim = state.bin_position[1] + state.bin_interior[1] / 2
        if opened or state.object_pose[1] < rim + 0.03:
            opened.append(step)
            return STILL + np.array([0, 0, 0.1, 0], np.float32)
        return expert.advise(state).action

    return recover_episode(env, executed(env, act)), opened[0]


@pytest.fixture(scope="module")
def found() -> tuple:
    """What both of them found, in a process that never renders."""
    with open_workers(2) as submit:
        running = submit(found_after_a_push), submit(found_after_a_release)
        return tuple(one.result() for one in running)


def test_the_push_is_found_to_the_step(found):
    first, again, wrong = found[0]
    assert first.last_step_extra == PUSH - 1 and first.lost == Lost.PUSHED and first.is_hopeless
    took = dict(zip(first.tried, first.took, strict=True))
    assert took[PUSH - 1] != FAILED == took[PUSH]
    assert first.last_step + took[first.last_step] <= STEPS < first.last_step + 1 + took[first.last_step + 1]
    assert replace(again, is_drawn=False, tried=first.tried, took=first.took) == first, "the same, twice"
    assert {*range(0, STEPS, 10), *first.tried} == {*again.tried}
    everywhere = dict(zip(again.tried, again.took, strict=True))
    assert everywhere.items() >= took.items() and all((everywhere[t] != FAILED) == (t < PUSH) for t in everywhere)
    assert (wrong.lost, wrong.last_step, wrong.tried) == (Lost.UNSEEN, None, []), "a replay refuses it too"


def test_the_release_over_the_rim_is_found_to_the_step(found):
    recovery, opened = found[1]
    assert recovery.last_step == recovery.last_step_extra == opened
    assert (recovery.lost, recovery.phase) == (Lost.BESIDE, "CARRY")


def test_the_command_twice_and_a_board(tmp_path):
    root, table = tmp_path / "board", tmp_path / "board" / "recovered" / "mine.parquet"
    entry = read_submission(ENTRIES / "bins_paper_cls")
    claims = [one for one in entry.claims if one.training_seed in (0, 7)]
    told = {name: getattr(entry.declaration, name) for name in ("about", "suite", "settings", "backend", "versions")}
    write_submission(root / "entries" / "mine", claims, training_seeds=[0, 7], **told)
    said = call("constructskill-recover", f"--root={root}")
    assert "mine, brick_to_bin: 2 failed episodes: released too early 2" in said and "1 table written" in said
    content = table.read_bytes()
    assert "0 tables written" in call("constructskill-recover", f"--root={root}", "--entries=[mine]")
    table.unlink()
    call("constructskill-recover", f"--root={root}")
    assert table.read_bytes() == content
    assert "no entry 'yours'" in call("constructskill-recover", f"--root={root}", "--entries=[yours]", fails=True)
    call("constructskill-board", f"--root={root}", f"--out={tmp_path / 'site'}")
    rows = pq.read_table(tmp_path / "site" / "board.parquet").to_pylist()
    assert [(row["last_step"], row["last_step_extra"]) for row in rows] == [(82, 82), (169, 300)]
    assert "released too early 2" in (tmp_path / "site" / "bins.html").read_text()
