"""Which attempts are run and which shards are taken, with made-up attempts: neither simulator nor video."""

import json
import random
import time
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import asdict, replace
from types import SimpleNamespace

import pytest

from lerobot_constructskill.artifacts import disk
from lerobot_constructskill.contract import SIM_STATE, SUITES
from lerobot_constructskill.demos import merge, recorder, shards
from lerobot_constructskill.demos.expert import ExpertConfig
from lerobot_constructskill.demos.node import Demonstrations
from lerobot_constructskill.demos.noise import NoiseConfig
from lerobot_constructskill.demos.recorder import GenerateConfig, record
from lerobot_constructskill.demos.settings import frames_digest, generator_facts
from lerobot_constructskill.demos.shards import Attempt, Block
from lerobot_constructskill.demos.video import VIDEOS
from lerobot_constructskill.errors import InputError, MachineError

CONFIG = GenerateConfig("local/set", episodes=6, seed_start=0)
FAILS = {0, 3, 4, 8}


@pytest.fixture
def attempted(monkeypatch):
    """The seeds that were run, in the order in which they ended; an attempt takes a few random milliseconds."""
    seeds = []

    def attempt(config, seed, folder):
        time.sleep(random.random() / 100)
        seeds.append(seed)
        return Attempt(seed, seed not in FAILS, 10, True, "cpu")

    @contextmanager
    def threads(executor, workers):
        with ThreadPoolExecutor(workers) as pool:
            yield pool.submit

    monkeypatch.setattr(recorder, "attempt", attempt)
    monkeypatch.setattr(recorder, "open_pool", threads)
    return seeds


def run_attempts(config, blocks):
    with recorder.open_pool(config.executor, config.workers) as submit:
        recorder._run_attempts(config, blocks, submit)


def attempts_of(config, folder):
    """The attempts at the only task, whose shards are in `folder`."""
    block = Block(config, folder)
    run_attempts(config, [block])
    return block.attempts


@pytest.mark.parametrize("workers", [1, 2, 3, 8])
def test_the_first_successes_in_the_order_of_seeds_are_taken_whatever_the_workers(workers, attempted, tmp_path):
    attempts = attempts_of(replace(CONFIG, workers=workers), tmp_path)
    assert [attempt.seed for attempt in attempts] == sorted(attempted) == list(range(10))
    assert [attempt.seed for attempt in attempts if attempt.success] == [1, 2, 5, 6, 7, 9]


@pytest.mark.parametrize("workers", [1, 2, 3, 8])
def test_the_attempts_of_each_of_several_tasks_are_those_of_the_task_alone(workers, attempted, tmp_path):
    config = replace(CONFIG, task="bins", workers=workers)
    blocks = [Block(part, tmp_path / part.task) for part in config.parts]
    (tmp_path / "block_to_bin" / "3").mkdir(parents=True)
    (tmp_path / "block_to_bin" / "3" / shards.OUTCOME).write_text(
        json.dumps(asdict(Attempt(3, False, 9, True, "cpu")))
    )
    run_attempts(config, blocks)
    assert [block.config.task for block in blocks] == [*SUITES["bins"]]
    for block in blocks:
        assert [attempt.seed for attempt in block.attempts] == list(range(10)) and block.discarded == [0, 3, 4, 8]
    assert sorted(attempted) == sorted([*range(10), *range(10), *(seed for seed in range(10) if seed != 3)])


def test_a_task_of_several_at_which_too_many_attempts_fail_ends_the_run(attempted, tmp_path):
    config = replace(CONFIG, task="bins", max_failures=0.5)
    with pytest.raises(InputError, match="4 attempts at brick_to_bin failed"):
        run_attempts(config, [Block(part, tmp_path / part.task) for part in config.parts])


def test_shards_of_a_task_serve_a_set_of_several():
    """And what a set of one task is found by does not know of the choice."""
    parts = replace(CONFIG, task="bins").parts
    assert [frames_digest(part) for part in parts] == [
        frames_digest(replace(CONFIG, task=task)) for task in SUITES["bins"]
    ]
    listed = replace(CONFIG, task=",".join(SUITES["bins"]))
    assert generator_facts(listed) == generator_facts(replace(CONFIG, task="bins"))
    assert not {"action", "cameras"} & generator_facts(CONFIG).keys()
    assert Demonstrations(listed).digest != Demonstrations(replace(listed, action="full")).digest


@pytest.mark.parametrize(
    "task, said",
    [
        ("brick_to_bin,wall_of_ten", "Unknown task 'wall_of_ten'"),
        ("bins,brick_to_bin", "names a task twice"),
        ("brick_to_bin,brick_to_bin_turned", "action=full"),
    ],
)
def test_tasks_that_no_set_can_have_are_refused(task, said):
    with pytest.raises(InputError, match=said):
        replace(CONFIG, task=task)


@pytest.mark.parametrize("workers", [1, 3])
def test_finished_shards_are_not_run_again_and_half_written_ones_are(workers, attempted, tmp_path):
    for seed in (1, 4, 7, 50):
        (tmp_path / str(seed)).mkdir()
        (tmp_path / str(seed) / shards.OUTCOME).write_text(
            json.dumps(asdict(Attempt(seed, seed != 4, 10, True, "cpu")))
        )
    (tmp_path / "5.partial" / "dataset").mkdir(parents=True)
    (tmp_path / "5.partial" / "dataset" / shards.OUTCOME).touch()
    attempts = attempts_of(replace(CONFIG, workers=workers), tmp_path)
    assert [attempt.seed for attempt in attempts] == list(range(10))
    assert sorted(attempted) == [0, 2, 3, 5, 6, 8, 9]


@pytest.mark.parametrize(
    "change",
    [
        {"task": "block_to_bin"},
        {"obs_type": "pixels_agent_pos"},
        {"max_steps": 999},
        {"light_robot": False},
        {"action": "full"},
        {"labels": "executed"},
        {"video": "lossless"},
        {"expert": ExpertConfig(gain=0.9)},
        {"noise": NoiseConfig(sigma=0.02)},
    ],
)
def test_shards_of_other_settings_are_elsewhere(change):
    assert frames_digest(replace(CONFIG, **change)) != frames_digest(CONFIG)


def test_data_of_other_columns_or_another_encoder_is_other_data(monkeypatch):
    """Or what an earlier version made would count as made, and the shards that it finished be mixed with new ones."""
    config = replace(CONFIG, video="lossless", light_robot=True)
    options = VIDEOS["lossless"].encoder | {"g": 20}
    before = frames_digest(config), Demonstrations(config).digest
    with monkeypatch.context() as patch:
        patch.setitem(VIDEOS, "lossless", replace(VIDEOS["lossless"], encoder=options))
        encoded = frames_digest(config), Demonstrations(config).digest
    with monkeypatch.context() as patch:
        patch.delitem(SIM_STATE, "joint_velocities")
        seen = frames_digest(config), Demonstrations(config).digest
    assert before == (frames_digest(config), Demonstrations(config).digest)
    assert all(len({*digests}) == 3 for digests in zip(before, encoded, seen, strict=True))


def test_shards_serve_more_episodes_other_names_and_any_number_of_workers():
    changed = GenerateConfig("a/b", "c", episodes=7, max_failures=0.1, seed_start=3, workers=2, executor="ray")
    assert frames_digest(changed) == frames_digest(CONFIG)


def test_a_disk_that_is_too_small_is_told_before_anything_is_written(monkeypatch, tmp_path):
    usage = type("Usage", (), {"free": 10_000_000})
    monkeypatch.setattr(disk.shutil, "disk_usage", lambda folder: usage)
    with pytest.raises(OSError, match="10 MB free and 6 episodes") as error:
        record(replace(CONFIG, root=str(tmp_path / "deep" / "set")))
    assert "\n" not in str(error.value) and list(tmp_path.iterdir()) == []


def test_machines_that_draw_the_robot_differently_are_not_mixed(tmp_path):
    for other, said in (
        (Attempt(1, True, 10, False, "cpu"), "light_robot"),
        (Attempt(1, True, 10, True, "gpu"), "some"),
    ):
        with pytest.raises(ValueError, match=said):
            block = Block(CONFIG, tmp_path, [Attempt(0, True, 10, True, "cpu"), other])
            merge.merge(CONFIG, [block], tmp_path / "set")


@pytest.mark.parametrize("content", ["", "[]", "null", '{"seed": 1}'])
def test_an_attempt_that_lost_its_content_is_run_again(content, attempted, tmp_path):
    (tmp_path / "1").mkdir()
    (tmp_path / "1" / shards.OUTCOME).write_text(content)
    attempts = attempts_of(CONFIG, tmp_path)
    assert sorted(attempted) == [attempt.seed for attempt in attempts] == list(range(10))
    assert not (tmp_path / "1").exists()  # in the way of the new one


def test_a_full_disk_is_said_in_one_sentence(tmp_path, monkeypatch):
    monkeypatch.setattr(disk.shutil, "disk_usage", lambda path: SimpleNamespace(free=4096))
    with pytest.raises(MachineError, match=f"The disk of {tmp_path} is full"), disk.room_for(tmp_path / "a" / "b"):
        raise RuntimeError("Encoder thread failed: [Errno 28]")
    with pytest.raises(InputError, match="another"), disk.room_for(tmp_path):
        raise InputError("another")
    monkeypatch.undo()
    with pytest.raises(RuntimeError), disk.room_for(tmp_path):
        raise RuntimeError("a fault of ours")


def test_a_disk_that_scratch_files_fill_is_measured_before_they_are_gone(tmp_path, monkeypatch):
    """Stands in for LeRobot's aggregation and for the disk: a real one would have to be filled."""

    def aggregate(repo_id, roots, folder, scratch):
        (scratch / "large").touch()
        raise RuntimeError("Encoder thread failed")

    usage = lambda path: SimpleNamespace(free=0 if list(tmp_path.rglob("large")) else 10**9)  # noqa: E731
    monkeypatch.setattr(merge, "aggregate", aggregate)
    monkeypatch.setattr(disk.shutil, "disk_usage", usage)
    with pytest.raises(MachineError, match="is full"):
        merge.merge(CONFIG, [Block(CONFIG, tmp_path, [Attempt(0, True, 10, True, "cpu")])], tmp_path / "set")
