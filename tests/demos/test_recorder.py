"""Data sets of demonstrations: real LeRobotDataset files, written, read back and replayed."""

import hashlib
import json
import os
import signal
import subprocess
import sys
import threading
import time

import numpy as np
import pytest
import torch
from commands import call
from lerobot.datasets.lerobot_dataset import LeRobotDataset
from lerobot.datasets.video_utils import _CameraEncoderThread

from lerobot_constructskill.contract import DEMO_SEED_START, FPS, SIM_STATE, TASKS
from lerobot_constructskill.dataset.checks import CHECKS, complaints
from lerobot_constructskill.dataset.dataset import open_dataset
from lerobot_constructskill.demos.columns import SIDECAR, demonstration_features
from lerobot_constructskill.demos.demonstrate import demonstrate
from lerobot_constructskill.demos.expert import ExpertConfig, Phase, PrivilegedState, make_expert
from lerobot_constructskill.demos.recorder import GenerateConfig, record
from lerobot_constructskill.demos.shards import write_episode
from lerobot_constructskill.envs.gym_env import ConstructSkillEnv
from lerobot_constructskill.errors import MachineError
from lerobot_constructskill.scripts.dataset import replay_episode

pytestmark = pytest.mark.sim
NEVER = ExpertConfig(lift_height=0.01, release_clearance=-0.1)
"""An expert that drags the brick against the bin."""


@pytest.fixture(scope="module")
def recorded(demonstrations):
    """Three noisy demonstrations with the wrist camera, and their frames as a table."""
    dataset = LeRobotDataset("local/demos", root=demonstrations)
    return dataset, dataset.hf_dataset.with_format("numpy")[:]


def test_the_columns_are_those_that_policies_may_see_and_no_others(recorded):
    dataset, _ = recorded
    seen = {name for name in dataset.features if name.startswith(("observation", "action"))}
    cameras = {"observation.images.base", "observation.images.wrist"}
    assert seen == {"action", "observation.state"} | cameras
    assert {f"sim.{name}" for name in SIM_STATE} <= set(dataset.features)
    assert dataset.features["action"]["names"] == list(TASKS["brick_to_bin"].action_names)
    assert dataset.fps == FPS


def test_frames_tasks_and_seeds_are_right(recorded):
    dataset, table = recorded
    frame = dataset[0]
    assert frame["task"] == TASKS["brick_to_bin"].instruction
    assert frame["observation.images.base"].shape == (3, 224, 224)
    assert float(frame["observation.images.base"].std()) > 0.05
    assert list(dict.fromkeys(table["sim.seed"])) == [DEMO_SEED_START + i for i in range(3)]
    assert (dataset.num_episodes, dataset.num_frames) == (3, len(table["index"]))


def test_the_statistics_are_those_of_all_frames(recorded):
    dataset, table = recorded
    stats, action = dataset.meta.stats["action"], table["action"]
    assert list(json.loads((dataset.root / "meta" / "stats.json").read_text())) == sorted(dataset.meta.stats)
    np.testing.assert_allclose(stats["mean"], action.mean(axis=0), atol=1e-6)
    np.testing.assert_allclose(stats["std"], action.std(axis=0), atol=1e-6)
    state, of_state = table["observation.state"].astype(np.float64), dataset.meta.stats["observation.state"]
    np.testing.assert_allclose(of_state["std"], state.std(axis=0), rtol=1e-3)  # one angle is pi and hardly moves
    for name, quantile in (("q01", 0.01), ("q50", 0.5), ("q99", 0.99)):
        np.testing.assert_allclose(stats[name], np.quantile(action, quantile, axis=0), atol=1e-3)


def test_noise_is_where_the_phase_allows_it_and_exactly_zero_elsewhere(recorded):
    _, table = recorded
    added = table["dart.executed_action"] - table["action"]
    contact = np.isin(table["phase"], [Phase.GRASP, Phase.RELEASE])
    assert (added[contact] == 0).all() and (table["dart.noise"][contact] == 0).all()
    free = added[~contact, :3]
    assert (added[:, 3] == 0).all()
    np.testing.assert_allclose(free.std(axis=0), 0.01, rtol=0.25)
    assert (np.abs(free.mean(axis=0)) < 4 * 0.01 / np.sqrt(len(free))).all()
    np.testing.assert_allclose(added[:, :3], table["dart.noise"], atol=1e-7)


def test_replaying_the_executed_actions_reproduces_every_state_and_outcome(demonstrations):
    data = open_dataset(demonstrations)
    assert [replay_episode(data, episode) for episode in range(3)] == [(True, 0.0)] * 3


def test_a_replay_tells_an_outcome_that_is_not_the_recorded_one(demonstrations):
    data = open_dataset(demonstrations)
    data.rows["next.reward"] = data.rows["next.reward"].where(data.rows["frame_index"] != 50, 1.0)
    assert not replay_episode(data, 1)[0]


def test_the_simulators_data_set_passes_every_check(demonstrations):
    data = open_dataset(demonstrations)
    assert {name: complaints(data, check) for name, check in CHECKS.items()} == {name: [] for name in CHECKS}


def test_labels_are_what_was_executed_or_is_advised_where_that_is_asked_for():
    config = GenerateConfig("local/set", labels="executed")
    env = ConstructSkillEnv("brick_to_bin", episode_length=30, render_backend="none")
    expert = make_expert(TASKS["brick_to_bin"], config.expert)
    clean, _ = demonstrate(env, expert, config.noise, 0)
    env.close()
    executed, _ = demonstrate(env, expert, config.noise, 0, config.labels)
    env.close()
    advised, _ = demonstrate(env, expert, config.noise, 0, "advice")
    env.close()
    for one, other, third in zip(clean, executed, advised, strict=True):
        np.testing.assert_array_equal(other["action"], one["dart.executed_action"])
        state = PrivilegedState(**{name: third[f"sim.{name}"] for name in SIM_STATE})
        np.testing.assert_array_equal(third["action"], expert.advise(state).action)
        np.testing.assert_array_equal(third["dart.executed_action"], one["dart.executed_action"])
        np.testing.assert_array_equal(other["dart.executed_action"], one["dart.executed_action"])
        assert (one["action"][:3] != one["dart.executed_action"][:3]).all()


def test_a_set_of_one_camera_is_the_set_of_both_without_the_other(recorded, tmp_path):
    both, frames = recorded
    root = tmp_path / "set"
    record(GenerateConfig("local/one", str(root), episodes=1, obs_type="pixels_agent_pos", cameras=["wrist"]))
    one, data = LeRobotDataset("local/one", root=root), open_dataset(root)
    assert one.meta.camera_keys == ["observation.images.wrist"]
    for name, values in one.hf_dataset.with_format("numpy")[:].items():
        np.testing.assert_array_equal(values, frames[name][: len(values)], err_msg=name)
    assert torch.equal(one[5]["observation.images.wrist"], both[5]["observation.images.wrist"])
    assert {name: complaints(data, check) for name, check in CHECKS.items()} == {name: [] for name in CHECKS}
    assert replay_episode(data, 0) == (True, 0.0)
    call("constructskill-card", f"--root={root}")
    card = (root / "README.md").read_text()
    assert "--policy.camera=wrist --env.obs_type=pixels_agent_pos \\\n    --env.type" in card
    assert "observation.images.wrist" in card and "`observation.images.base`" not in card


def test_a_lossless_set_has_every_pixel_as_it_was_rendered_and_the_same_bytes_on_any_number_of_cores(tmp_path):
    config = GenerateConfig("local/exact", str(tmp_path / "set"), episodes=2, video="lossless")
    _, attempts = record(config)
    env = ConstructSkillEnv(config.task, episode_length=config.max_steps)
    expert = make_expert(TASKS[config.task], config.expert)
    assert [attempt.seed for attempt in attempts] == list(range(DEMO_SEED_START, DEMO_SEED_START + len(attempts)))
    seeds = [attempt.seed for attempt in attempts if attempt.success]
    episodes = [demonstrate(env, expert, config.noise, seed)[0] for seed in seeds]
    env.close()
    dataset, key = LeRobotDataset("local/exact", root=tmp_path / "set"), "observation.images.base"
    facts = json.loads((dataset.root / SIDECAR).read_text())
    assert (len(seeds), sum(attempt.frames for attempt in attempts if attempt.success)) == (2, dataset.num_frames)
    assert facts["attempts"] == len(attempts)
    for row, frame in enumerate(frame for frames in episodes for frame in frames):
        seen = (dataset[row][key] * 255).round().permute(1, 2, 0).numpy()
        np.testing.assert_array_equal(seen, frame[key])
    data = open_dataset(dataset.root)
    assert {name: complaints(data, check) for name, check in CHECKS.items()} == {name: [] for name in CHECKS}
    features, cores = demonstration_features(TASKS[config.task], config.seen), os.sched_getaffinity(0)
    try:
        for name, some in (("one", {min(cores)}), ("all", cores)):
            os.sched_setaffinity(0, some)
            write_episode("local/e", TASKS[config.task], features, episodes[0], tmp_path / name, config.video)
    finally:
        os.sched_setaffinity(0, cores)
    one, all_of_them = (next((tmp_path / name).rglob("*.mp4")).read_bytes() for name in ("one", "all"))
    assert hashlib.sha256(one).digest() == hashlib.sha256(all_of_them).digest()


def test_how_the_set_was_made_travels_with_it(demonstrations):
    facts = json.loads((demonstrations / SIDECAR).read_text())
    np.testing.assert_allclose(facts["noise_covariance"], 1e-4 * np.eye(3))
    assert facts["generator"]["noise"]["sigma"] == 0.01 and facts["generator"]["light_robot"] in (True, False)


@pytest.mark.parametrize("in_the_end", [True, False])
def test_a_video_that_lerobot_gives_up_is_an_error(tmp_path, monkeypatch, in_the_end):
    """Its encoder stands still for longer than LeRobot waits, and then goes on at once, or too late."""
    columns, go_on = demonstration_features(TASKS["brick_to_bin"], ["base", "wrist"]), threading.Event()
    features = {name: columns[name] for name in ("observation.images.base", "observation.images.wrist", "action")}
    frame = {name: np.zeros(feature["shape"], np.float32) for name, feature in features.items()}
    encode, join = _CameraEncoderThread.run, threading.Thread.join

    def late(thread):
        thread.frame_queue.maxsize = 0  # or the end of the episode would wait for room in it
        go_on.wait()
        encode(thread)

    def impatient(thread, timeout):
        first = timeout == 120
        join(thread, 0.01 if first or not in_the_end else timeout)
        if first and in_the_end:
            go_on.set()

    monkeypatch.setattr(_CameraEncoderThread, "run", late)
    monkeypatch.setattr(_CameraEncoderThread, "join", impatient)
    with pytest.raises(MachineError, match="The same command goes on"):
        write_episode("local/e", TASKS["brick_to_bin"], features, [frame] * 3, tmp_path / "e", "av1")
    go_on.set()


def test_failed_attempts_are_discarded_and_end_a_hopeless_run(tmp_path):
    config = GenerateConfig(
        "local/none", str(tmp_path / "none"), episodes=2, max_steps=60, max_failures=0.5, expert=NEVER
    )
    with pytest.raises(ValueError, match="2 attempts failed"):
        record(config)
    assert not (tmp_path / "none").exists()


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
        (["--noise.model=dart"], "constructskill-fit-noise"),
        (["--workers=0"], "workers"),
        (["--episodes=0"], "episodes"),
        (["--obs_type=rgb"], "pixels_agent_pos"),
        (["--cameras=[wrist]"], "cameras must be some of base, which pixels has, not wrist."),
        (["--obs_type=pixels_agent_pos", "--cameras=[]"], "base, wrist, which pixels_agent_pos has, not none."),
        (["--config_path=/dev/null"], "'/dev/null' is not a regular file."),
    ],
)
def test_the_command_answers_bad_input_in_one_sentence(flags, words, tmp_path):
    said = call("constructskill-generate", "--repo_id=local/set", f"--root={tmp_path / 'set'}", *flags, fails=True)
    assert words in said and len(said.strip().splitlines()) == 1
    assert not (tmp_path / "set").exists()


@pytest.mark.nightly
def test_a_killed_run_of_two_workers_continues_to_the_bytes_of_an_undisturbed_one(demonstrations, tmp_path):
    root = tmp_path / "set"
    flags = ["--episodes=3", "--obs_type=pixels_agent_pos", "--workers=2"]
    killed = generate(root, *flags)
    wait_for(tmp_path, "set.partial/shards/*/*/attempt.json", killed)
    killed.send_signal(signal.SIGKILL)
    killed.wait()
    assert not root.exists()
    half = next(tmp_path.glob("set.partial/shards/*")) / "1000002.partial"
    half.mkdir(exist_ok=True)
    (half / ".constructskill").touch()
    (half / "dataset").mkdir(exist_ok=True)
    resumed = generate(root, *flags)
    _, stderr = resumed.communicate()
    assert resumed.returncode == 0, stderr
    assert [path.name for path in tmp_path.iterdir()] == ["set"]
    assert hashes(root) == hashes(demonstrations)


@pytest.mark.nightly
@pytest.mark.parametrize("executor", ["processes", "ray"])
def test_a_set_with_a_wall_has_the_same_bytes_with_two_workers_and_after_a_kill(tmp_path, executor):
    if executor == "ray":
        pytest.importorskip("ray", reason="the extra `distributed` brings it")
    flags = ["--task=course_of_three,brick_to_bin_turned", "--action=full", "--episodes=2", "--annotate=true"]
    _, stderr = (whole := generate(tmp_path / "whole", *flags)).communicate()
    assert whole.returncode == 0, stderr
    killed = generate(tmp_path / "set", *flags, "--workers=2")
    wait_for(tmp_path, "set.partial/shards/*/*/attempt.json", killed)
    killed.send_signal(signal.SIGKILL)
    killed.wait()
    again = generate(tmp_path / "set", *flags, "--workers=2", f"--executor={executor}")
    _, stderr = again.communicate()
    assert again.returncode == 0, stderr
    assert hashes(tmp_path / "set") == hashes(tmp_path / "whole")
    data = open_dataset(tmp_path / "set")
    assert {name: complaints(data, check) for name, check in CHECKS.items()} == {name: [] for name in CHECKS}
    assert [replay_episode(data, episode) for episode in range(4)] == [(True, 0.0)] * 4


@pytest.mark.slow
def test_the_replay_command_says_how_many_ended_as_recorded(demonstrations):
    said = call("constructskill-replay", f"--root={demonstrations}", "--episodes=[2]")
    assert "1 demonstration ended as recorded" in said


@pytest.mark.nightly
def test_ray_makes_the_same_bytes(demonstrations, tmp_path):
    pytest.importorskip("ray", reason="the extra `distributed` brings it")
    run = generate(tmp_path / "set", "--episodes=3", "--obs_type=pixels_agent_pos", "--workers=2", "--executor=ray")
    _, stderr = run.communicate()
    assert run.returncode == 0, stderr
    assert hashes(tmp_path / "set") == hashes(demonstrations)


def hashes(root):
    """Of the data set; the card that the command writes beside it is another test's."""
    files = [path for folder in ("data", "videos", "meta") for path in (root / folder).rglob("*") if path.is_file()]
    return {str(path.relative_to(root)): hashlib.sha256(path.read_bytes()).hexdigest() for path in files}


def wait_for(folder, pattern, process):
    while not list(folder.glob(pattern)):
        assert process.poll() is None, process.communicate()
        time.sleep(0.02)


def generate(root, *flags):
    command = [
        sys.executable,
        "-m",
        "lerobot_constructskill.scripts.generate",
        "--repo_id=local/demos",
        f"--root={root}",
    ]
    return subprocess.Popen([*command, *flags], stderr=subprocess.PIPE, text=True)
