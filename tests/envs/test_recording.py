"""What is recorded is what was executed: a recording, executed again, ends alike, whoever ran it."""

import os

import numpy as np
import pytest
from commands import call

from lerobot_constructskill.contract import get_task
from lerobot_constructskill.envs.gym_env import ConstructSkillEnv
from lerobot_constructskill.envs.recording import (
    COUNTS,
    FOLDER,
    Episode,
    read_recordings,
    recording_into,
    write_recordings,
)
from lerobot_constructskill.envs.vector_env import NativeVectorEnv
from lerobot_constructskill.errors import InputError

NOTHING_YET = dict.fromkeys(("is_lifted", "is_in_bin", "is_success"), False) | dict.fromkeys((*COUNTS, "cost"), 0)
DOWN_OPEN = np.array([0.01, 0.02, -0.03, 1], dtype=np.float64)


def test_recordings_are_read_as_they_were_written(tmp_path):
    made = [Episode(7, lifted=True, stage="lifted", lift_step=2, task="brick_to_bin"), Episode(8)]
    made[0].add(np.float32([0.1, 0, -0.1, 1]), NOTHING_YET | {"is_lifted": True})
    write_recordings(made, tmp_path / "some.parquet")
    read = read_recordings(tmp_path / "some.parquet")
    for one, other in zip(made, read, strict=True):
        np.testing.assert_array_equal(one.flat, other.flat)
        assert vars(one) | {"actions": 0} == vars(other) | {"actions": 0}
    (tmp_path / "other.parquet").write_bytes(b"no parquet")
    with pytest.raises(InputError, match="cannot be read"):
        read_recordings(tmp_path / "other.parquet")


def test_an_array_that_its_caller_uses_again_is_recorded_as_it_was():
    recording, action = Episode(7), np.zeros(4, np.float32)
    for number in range(3):
        action[:] = number
        recording.add(action, NOTHING_YET)
    np.testing.assert_array_equal(recording.flat, np.repeat(np.float32([0, 1, 2]), 4))


def test_an_episode_keeps_the_furthest_stage_and_the_first_step_of_each_milestone():
    episode, nothing = Episode(1000), NOTHING_YET
    for info in ({}, {"is_lifted": True}, {"is_lifted": True, "is_in_bin": True}, {"is_lifted": True}):
        episode.add(np.zeros(4), nothing | info)
    assert (episode.stage, episode.lift_step, episode.place_step, episode.steps) == ("in_bin", 2, None, 4)
    assert episode.lifted and not episode.placed


@pytest.mark.sim
def test_every_finished_episode_is_recorded_and_no_other(tmp_path, monkeypatch):
    monkeypatch.setenv(FOLDER, str(tmp_path / "kept"))
    env = ConstructSkillEnv("block_to_bin", episode_length=3, render_backend="none", perturb="pose=1")
    for seed in (5, 6, 5):
        env.reset(seed=seed)
        for _ in range(3):
            env.step(DOWN_OPEN)
    env.reset(seed=7)
    env.step(DOWN_OPEN)
    env.close()
    files = sorted((tmp_path / "kept").iterdir())
    recordings = [recording for path in files for recording in read_recordings(path)]
    assert [one.evaluation_seed for one in recordings] == [5, 6]
    for one in recordings:
        assert (one.task, one.episode_length, one.perturb, one.perturb_seed) == ("block_to_bin", 3, "pose=1", 0)
        assert (one.steps, one.stage, one.backend.split(",")[0]) == (3, "none", "physx_cpu")
        np.testing.assert_array_equal(one.flat, np.tile(DOWN_OPEN.astype(np.float32), 3))


STEP_TWO = """
import numpy as np
from lerobot_constructskill.envs.configuration_constructskill import ConstructSkillEnvConfig
config = ConstructSkillEnvConfig(task="block_to_bin", episode_length=2)
vector = config.create_envs(n_envs=2, use_async_envs={use_async_envs})["constructskill"][0]
vector.reset(seed=[7, 8], options={{"lerobot_new_rollout": True}})
for _ in range(5):  # a frozen episode goes on returning, and is over
    vector.step(np.tile([0, 0, 0.01, 1], (2, 1)))
vector.close()
"""


@pytest.mark.sim
@pytest.mark.parametrize("use_async_envs", [False, True])
def test_lerobots_vector_environments_record(use_async_envs, tmp_path):
    """In a process of its own: a fork server that other tests have started does not hear of the variable."""
    code = STEP_TWO.format(use_async_envs=use_async_envs)
    call("code", code, **{FOLDER: str(tmp_path)})
    recordings = [recording for path in sorted(tmp_path.iterdir()) for recording in read_recordings(path)]
    assert [(one.evaluation_seed, one.steps, len(one.flat)) for one in recordings] == [
        (seed, 2, 2 * len(get_task("block_to_bin").action_names)) for seed in (7, 8)
    ]


def test_a_worker_records_where_its_user_says_and_not_where_its_server_was_told(monkeypatch):
    monkeypatch.setenv(FOLDER, "of an earlier time")
    assert recording_into("now", lambda: os.environ[FOLDER]) == "now"
    assert recording_into(None, lambda: os.environ.get(FOLDER)) is None


def test_what_cannot_be_recorded_is_refused(tmp_path, monkeypatch):
    monkeypatch.setenv(FOLDER, str(tmp_path))
    with pytest.raises(InputError, match="vectorization=process"):
        NativeVectorEnv(1)
