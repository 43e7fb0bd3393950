"""One action for every task: seven numbers, which move the robot as the task's own do where the others are 0."""

import numpy as np
import pytest

from lerobot_constructskill.contract import ANY_ACTION, FULL_ACTION, TASK_ACTION, TASKS, get_task, select_tasks
from lerobot_constructskill.demos.demonstrate import demonstrate
from lerobot_constructskill.demos.expert import ExpertConfig, make_expert
from lerobot_constructskill.demos.noise import NoiseConfig
from lerobot_constructskill.envs.actions import normalised
from lerobot_constructskill.envs.configuration_constructskill import ConstructSkillEnvConfig
from lerobot_constructskill.envs.gym_env import ConstructSkillEnv
from lerobot_constructskill.envs.recording import FOLDER, read_recordings
from lerobot_constructskill.errors import InputError

ALL_TASKS = ",".join(TASKS)


def test_a_channel_that_an_action_lacks_is_zero_to_the_last_bit():
    short, full = np.float32([0.01, -0.02, 0.0, 1]), np.float32([0.01, -0.02, -0.0, 0, -0.0, 0, 1])
    assert normalised(short, TASKS["brick_to_bin"].action_names).tobytes() == normalised(full, FULL_ACTION).tobytes()


def test_all_tasks_are_one_environment_of_seven_numbers():
    config = ConstructSkillEnvConfig(task=ALL_TASKS, action=ANY_ACTION)
    assert config.features["action"].shape == (7,)
    (tasks,) = config.create_envs(1).values()
    assert [env.single_action_space.shape for env in tasks.values()] == [(7,)] * len(TASKS)
    assert [channel["name"] for channel in tasks[0].call("contract")[0]["action"]["channels"]] == [*FULL_ACTION]
    assert "action" not in ConstructSkillEnvConfig().gym_kwargs


def test_tasks_whose_actions_differ_are_told_of_the_action_that_they_share():
    with pytest.raises(InputError, match="mixes tasks whose actions differ.* or action=full"):
        select_tasks("brick_to_bin,brick_to_bin_turned")
    with pytest.raises(InputError, match="action must be one of task, full, not 'half'"):
        ConstructSkillEnv(action="half")


@pytest.mark.sim
@pytest.mark.parametrize("task", TASKS)
def test_without_rotations_the_robot_moves_as_by_the_tasks_own_action(task):
    """Every number of the simulator's state, after actions that reach, push and close on what is there."""
    own, rng = TASKS[task].action_names, np.random.default_rng(0)
    places = [FULL_ACTION.index(name) for name in own]
    short = rng.uniform(-0.1, 0.1, (12, len(own))).astype(np.float32)
    short[3:6] = 0.0  # -0.0 in ManiSkill's sign of rotations
    full = np.zeros((12, 7), np.float32)
    full[:, places] = short
    found = []
    for action, actions in ((TASK_ACTION, short), (ANY_ACTION, full)):
        env = ConstructSkillEnv(task, render_backend="none", action=action)
        env.reset(seed=3)
        states = []
        for one in actions:
            env.step(one)
            states += [env.agent_state(), *env.privileged_state().values()]
        env.close()
        found.append(np.concatenate([state.ravel() for state in states]))
    assert found[0].tobytes() == found[1].tobytes()


@pytest.mark.sim
@pytest.mark.parametrize("task", ["brick_to_bin_40mm", "brick_to_bin_turned"])
def test_an_expert_gives_zeros_for_the_rotations_that_its_task_does_not_name(task, tmp_path, monkeypatch):
    """And what was recorded knows in which form it acted."""
    monkeypatch.setenv(FOLDER, str(tmp_path))
    frames, places = {}, [FULL_ACTION.index(name) for name in TASKS[task].action_names]
    for action in (TASK_ACTION, ANY_ACTION):
        env = ConstructSkillEnv(task, episode_length=25, render_backend="none", action=action)
        expert = make_expert(get_task(task, action), ExpertConfig())
        frames[action], _ = demonstrate(env, expert, NoiseConfig(), 1_000_000, "advice")
        env.close()
    for short, full in zip(frames[TASK_ACTION], frames[ANY_ACTION], strict=True):
        for name in ("action", "dart.executed_action"):
            assert full[name].shape == (7,) and not np.delete(full[name], places).any()
            np.testing.assert_array_equal(full[name][places], short[name])
        np.testing.assert_array_equal(full["observation.state"], short["observation.state"])
    episodes = {one.action: one for file in tmp_path.iterdir() for one in read_recordings(file)}
    assert {action: one.executed.shape for action, one in episodes.items()} == {
        TASK_ACTION: (25, len(places)),
        ANY_ACTION: (25, 7),
    }
    assert episodes[ANY_ACTION].environment == episodes[TASK_ACTION].environment | {"action": ANY_ACTION}
    assert episodes[ANY_ACTION].outcome == episodes[TASK_ACTION].outcome
