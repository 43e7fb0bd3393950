"""Actions from -1 to 1, where metres are asked for, are counted and told at every door.

Those of vla-evaluation-harness and of our rollouts: test_vla_evaluation_harness.py and test_lockstep.py.
"""

import gymnasium as gym
import numpy as np
import pytest
import torch

import lerobot_constructskill.sim.register  # noqa: F401
from lerobot_constructskill.contract import TASKS
from lerobot_constructskill.envs.configuration_constructskill import ConstructSkillEnvConfig
from lerobot_constructskill.envs.gym_env import ConstructSkillEnv
from lerobot_constructskill.envs.recording import FOLDER, read_recordings
from lerobot_constructskill.sim.actions import LEAST, Clipping

STEPS = LEAST + 2
NORMALISED = np.tile(np.float32([0.5, -0.9, 0.4, 1]), (STEPS, 1))
TASK = "block_to_bin"


@pytest.fixture(autouse=True)
def nobody_was_told(monkeypatch):
    monkeypatch.setattr(Clipping, "has_warned", False)


def of_lerobot(**kwargs):
    config = ConstructSkillEnvConfig(task=TASK, episode_length=STEPS, **kwargs)
    (vector,) = config.create_envs(n_envs=1)["constructskill"].values()
    vector.reset(seed=[0])
    infos = [vector.step(action[None])[-1] for action in NORMALISED]
    vector.close()
    return infos[-1]["clipped_steps"][0]


def of_gymnasium():
    env = ConstructSkillEnv(TASK, episode_length=STEPS, render_backend="none")
    env.reset(seed=0)
    infos = [env.step(action)[-1] for action in NORMALISED]
    env.close()
    return infos[-1]["clipped_steps"]


def of_maniskill():
    env = gym.make(TASKS[TASK].env_id, obs_mode="none", render_backend="none")
    env.reset(seed=0)
    wide = np.insert(NORMALISED * 10, 3, np.zeros((3, 1)), axis=1)
    infos = [env.step(action)[-1] for action in wide]
    env.close()
    return infos[-1]["clipped_steps"].item()


def of_lerobot_native():
    return of_lerobot(vectorization="native")


@pytest.mark.sim
@pytest.mark.parametrize("door", [of_lerobot, of_lerobot_native, of_gymnasium, of_maniskill])
def test_a_door_counts_what_it_clips_and_tells_it_once(door, caplog):
    assert door() == STEPS
    assert caplog.text.count(f"{LEAST} of the first {LEAST} actions") == 1 and "not -1 to 1" in caplog.text


@pytest.mark.sim
def test_the_count_is_an_episodes_own_and_is_recorded(tmp_path, monkeypatch):
    monkeypatch.setenv(FOLDER, str(tmp_path))
    env = ConstructSkillEnv(TASK, episode_length=2, render_backend="none")
    for seed, reach in ((1, 0.2), (2, 0.1)):
        _, info = env.reset(seed=seed)
        assert info["clipped_steps"] == 0
        for _ in range(2):
            env.step(np.float32([0, reach, 0, 1]))
    env.close()
    recorded = {one.evaluation_seed: one for path in tmp_path.iterdir() for one in read_recordings(path)}
    assert {seed: one.clipped_steps for seed, one in recorded.items()} == {1: 2, 2: 0}


def counted(clipping, *actions):
    for step, action in enumerate(actions):
        out = clipping.apply(torch.tensor(action, dtype=torch.float32), torch.tensor([step] * len(clipping.steps)))
        assert out[..., :-1].abs().max() <= 1
    return clipping.steps.tolist()


def test_a_translation_or_rotation_counts_and_a_gripper_does_not():
    moves, turns, grips = np.eye(7)[[2, 5, 6]] * -1.5
    assert counted(Clipping(3, torch.device("cpu")), np.stack([moves, turns, grips])) == [1, 1, 0]
    assert counted(Clipping(1, torch.device("cpu")), moves, turns, grips, np.ones(7)) == [2]


@pytest.mark.parametrize(
    "clipped, in_all, told", [(LEAST - 1, LEAST - 1, 0), (LEAST, 10 * LEAST, 0), (LEAST + 1, 100, 1)]
)
def test_a_few_clipped_actions_are_not_told(clipped, in_all, told, caplog):
    fine, wide = np.zeros(7), np.full(7, 2.0)
    for _ in range(2):  # once a process, whatever comes later
        counted(Clipping(1, torch.device("cpu")), *[fine] * (in_all - clipped), *[wide] * clipped)
    assert caplog.text.count("were clipped") == told
