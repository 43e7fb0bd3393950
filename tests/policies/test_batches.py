"""A batch that is read from memory holds what LeRobot reads frame by frame."""

import random

import pytest
import torch
from lerobot.datasets import LeRobotDataset
from torch.utils.data import DataLoader

from lerobot_constructskill.policies.frozen_vit.batches import Rows, _frames, read_whole_batches

DELTAS = {"action": [step / 20 for step in range(-2, 8)], "observation.state": [0.0, 0.05]}


@pytest.fixture(autouse=True)
def as_a_policy_on_features_does():
    read_whole_batches()


def same(found: dict, wanted: dict) -> None:
    assert [*found] == [*wanted]
    for name, value in wanted.items():
        if torch.is_tensor(value):
            assert found[name].dtype == value.dtype and torch.equal(found[name], value), name
        else:
            assert found[name] == value, name


@pytest.mark.parametrize("deltas", [None, DELTAS], ids=["frames", "chunks"])
@pytest.mark.parametrize("episodes", [None, [5, 1, 2]], ids=["all", "some"])
def test_a_batch_from_memory_is_what_lerobot_reads(feature_set, deltas, episodes):
    data = LeRobotDataset("local/random", root=feature_set.root, delta_timestamps=deltas, episodes=episodes)
    rows = random.Random(0).sample(range(len(data)), len(data))
    frames = data.__getitems__(rows)
    for found, row in zip(frames, rows, strict=True):
        same(found, data[row])
    assert data in _frames
    frames[0]["action"].zero_()
    same(data.__getitems__(rows[:1])[0], data[rows[0]])


def test_frames_that_were_selected_since_are_not_those_of_before(feature_set):
    data = LeRobotDataset("local/random", root=feature_set.root)
    data.__getitems__([0])
    data.reader.hf_dataset = data.hf_dataset.select(range(5, 20))
    same(data.__getitems__([0])[0], data[0])


def test_what_a_subclass_adds_to_a_frame_stays(feature_set):
    class WithMore(LeRobotDataset):
        def __getitem__(self, index):
            return super().__getitem__(index) | {"more": index}

    assert WithMore("local/random", root=feature_set.root).__getitems__([3])[0]["more"] == 3


def test_a_loader_gives_the_same_batches(feature_set):
    data = LeRobotDataset("local/random", root=feature_set.root, delta_timestamps=DELTAS)
    together = next(iter(DataLoader(data, batch_size=16)))
    same(together, torch.utils.data.default_collate([data[row] for row in range(16)]))


@pytest.mark.sim
def test_frames_with_videos_are_read_as_before(demonstrations):
    data = LeRobotDataset("local/demos", root=demonstrations)
    for found, row in zip(data.__getitems__([7, 3]), [7, 3], strict=True):
        same(found, data[row])
    assert data not in _frames


def test_what_lerobot_may_have_some_day_is_left_alone(monkeypatch):
    monkeypatch.setattr(LeRobotDataset, "__getitems__", theirs := object())
    read_whole_batches()
    assert LeRobotDataset.__getitems__ is theirs


def test_rows_lie_in_the_same_memory():
    rows, values = Rows(), torch.randn(9, 4, 3).half()
    first = rows.read(values, torch.tensor([8, 0, 8]))
    assert torch.equal(first, values[[8, 0, 8]])
    second = rows.read(values, torch.tensor([1, 2]))
    assert torch.equal(second, values[[1, 2]]) and second.data_ptr() == first.data_ptr()
