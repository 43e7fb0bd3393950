"""Data sets of demonstrations: real LeRobotDataset files, written, read back and replayed."""

import json
import signal
import subprocess
import sys
import time

import numpy as np
import pytest
from lerobot.datasets.lerobot_dataset import LeRobotDataset

from lerobot_constructskill.contract import DEMO_SEED_START, FPS, SIM_STATE, TASKS
from lerobot_constructskill.demos.columns import SIDECAR
from lerobot_constructskill.demos.expert import ExpertConfig, Phase
from lerobot_constructskill.demos.noise import NoiseConfig
from lerobot_constructskill.demos.recorder import GenerateConfig, record
from lerobot_constructskill.envs.gym_env import ConstructSkillEnv

pytestmark = pytest.mark.sim
NEVER = ExpertConfig(lift_height=0.01, release_clearance=-0.1)
"""An expert that drags the brick against the bin."""


@pytest.fixture(scope="module")
def recorded(tmp_path_factory):
    """Two noisy demonstrations with the wrist view, and their frames as a table."""
    root = tmp_path_factory.mktemp("data") / "set"
    summary = record(GenerateConfig("local/set", str(root), episodes=2, obs_type="pixels_agent_pos"))
    dataset = LeRobotDataset("local/set", root=root)
    return summary, dataset, dataset.hf_dataset.with_format("numpy")[:]


def test_the_columns_are_those_that_policies_may_see_and_no_others(recorded):
    _, dataset, _ = recorded
    seen = {name for name in dataset.features if name.startswith(("observation", "action"))}
    cameras = {"observation.images.base", "observation.images.wrist"}
    assert seen == {"action", "observation.state"} | cameras
    assert {f"sim.{name}" for name in SIM_STATE} <= set(dataset.features)
    assert dataset.features["action"]["names"] == list(TASKS["brick_to_bin"].action_names)
    assert dataset.fps == FPS


def test_frames_tasks_and_seeds_are_right(recorded):
    summary, dataset, table = recorded
    frame = dataset[0]
    assert frame["task"] == TASKS["brick_to_bin"].instruction
    assert frame["observation.images.base"].shape == (3, 224, 224)
    assert float(frame["observation.images.base"].std()) > 0.05
    assert sorted(set(table["sim.seed"])) == [DEMO_SEED_START, DEMO_SEED_START + 1]
    assert (summary.episodes, summary.frames) == (dataset.num_episodes, dataset.num_frames) == (2, len(table["index"]))


def test_noise_is_where_the_phase_allows_it_and_exactly_zero_elsewhere(recorded):
    *_, table = recorded
    added = table["dart.executed_action"] - table["action"]
    contact = np.isin(table["phase"], [Phase.GRASP, Phase.RELEASE])
    assert (added[contact] == 0).all() and (table["dart.noise"][contact] == 0).all()
    free = added[~contact, :3]
    assert (added[:, 3] == 0).all()
    np.testing.assert_allclose(free.std(axis=0), 0.01, rtol=0.25)
    assert (np.abs(free.mean(axis=0)) < 4 * 0.01 / np.sqrt(len(free))).all()
    np.testing.assert_allclose(added[:, :3], table["dart.noise"], atol=1e-7)


def test_replaying_the_executed_actions_reproduces_every_outcome(recorded):
    *_, table = recorded
    env = ConstructSkillEnv("brick_to_bin", "pixels_agent_pos")
    for episode in np.unique(table["episode_index"]):
        rows = np.flatnonzero(table["episode_index"] == episode)
        env.reset(seed=int(table["sim.seed"][rows[0]]))
        for row in rows:
            np.testing.assert_allclose(env.agent_state(), table["observation.state"][row], atol=1e-4)
            _, reward, success, *_ = env.step(table["dart.executed_action"][row])
            assert (reward, success) == (table["next.reward"][row], table["next.success"][row])
        assert success
    env.close()


def test_how_the_set_was_made_travels_with_it(recorded):
    summary, dataset, _ = recorded
    facts = json.loads((dataset.root / SIDECAR).read_text())
    assert facts["generator"]["noise"]["sigma"] == 0.01 and facts["generator"]["light_robot"] in (True, False)
    assert facts["attempts"] == summary.episodes + len(summary.discarded_seeds)


def test_failed_attempts_are_discarded_and_end_a_hopeless_run_with_nothing_left(tmp_path):
    config = GenerateConfig(
        "local/none", str(tmp_path / "none"), episodes=2, max_steps=60, max_failures=0.5, expert=NEVER
    )
    with pytest.raises(ValueError, match="2 attempts failed"):
        record(config)
    assert list(tmp_path.iterdir()) == []


def test_an_existing_folder_is_refused_and_left_alone(tmp_path):
    (tmp_path / "mine.txt").write_text("keep")
    with pytest.raises(FileExistsError, match="exists already"):
        record(GenerateConfig("local/set", str(tmp_path)))
    assert (tmp_path / "mine.txt").read_text() == "keep"


@pytest.mark.parametrize(
    "flags, words",
    [
        (["--task=bricks"], "brick_to_bin"),
        (["--noise.sigma=-1"], "sigma"),
        (["--noise.phases=[GRASPING]"], "PREGRASP"),
        (["--episodes=0"], "episodes"),
        (["--obs_type=rgb"], "pixels_agent_pos"),
        (["--config_path=/dev/null"], "empty"),
    ],
)
def test_the_command_answers_bad_input_in_one_sentence(flags, words, tmp_path):
    run = generate(tmp_path / "set", *flags)
    _, stderr = run.communicate()
    assert run.returncode != 0 and words in stderr
    assert len(stderr.strip().splitlines()) == 1
    assert not (tmp_path / "set").exists()


def test_a_killed_generation_leaves_no_data_set_and_the_next_one_is_whole(tmp_path):
    root = tmp_path / "set"
    killed = generate(root, "--episodes=50")
    data = root.with_name("set.partial") / "dataset" / "data"
    while not data.exists():
        assert killed.poll() is None, killed.communicate()
        time.sleep(0.2)
    killed.send_signal(signal.SIGKILL)
    killed.wait()
    assert not root.exists()
    summary = record(GenerateConfig("local/set", str(root), episodes=1, noise=NoiseConfig(sigma=0.0)))
    assert summary.episodes == 1 and [path.name for path in tmp_path.iterdir()] == ["set"]
    assert len(LeRobotDataset("local/set", root=root)) == summary.frames


def generate(root, *flags):
    command = [
        sys.executable,
        "-m",
        "lerobot_constructskill.scripts.generate",
        "--repo_id=local/set",
        f"--root={root}",
    ]
    return subprocess.Popen([*command, *flags], stderr=subprocess.PIPE, text=True)
