"""What makes the merging of many demonstrations fast changes nothing."""

import pytest
import torch
from lerobot.datasets import LeRobotDataset
from toy import record_toy

from lerobot_constructskill.demos import merge
from lerobot_constructskill.demos.metadata import file_hashes
from lerobot_constructskill.lerobot_internals import load_episodes

pytestmark = pytest.mark.slow


@pytest.fixture
def lerobots_way(monkeypatch):
    """LeRobot reads all that there is of the episodes that it merges."""
    monkeypatch.setattr(merge, "kept_of_episodes", load_episodes)


def test_what_lerobot_keeps_of_episodes_is_what_it_is_given(pristine):
    ours, theirs = merge.kept_of_episodes(pristine), load_episodes(pristine)
    assert ours.column_names == theirs.column_names
    assert ours.features == theirs.features and ours[:] == theirs[:]


def test_statistics_are_of_one_column_after_another(pristine, monkeypatch):
    """All of them at once would not fit: a long set's columns are gigabytes."""
    read, asked = merge.read_parquet, []

    def note(path, columns):
        asked.append(columns)
        return read(path, columns)

    monkeypatch.setattr(merge, "read_parquet", note)
    statistics = merge.frame_statistics(pristine)
    assert asked == [[name] for name in statistics]


def test_a_set_is_the_same_file_for_file_as_lerobot_merges_it(pristine, tmp_path, lerobots_way):
    record_toy(tmp_path / "plain", episodes=9)
    assert file_hashes(tmp_path / "plain") == file_hashes(pristine)


def test_groups_of_groups_hold_the_same_frames_in_the_same_order(pristine, tmp_path, monkeypatch):
    monkeypatch.setattr(merge, "GROUP", 2)  # nine demonstrations: five groups, three, two, one
    record_toy(tmp_path / "grouped", episodes=9)
    one, other = (LeRobotDataset("local/toy", root=root) for root in (pristine, tmp_path / "grouped"))
    assert len(one) == len(other) and one.num_episodes == other.num_episodes == 9
    for index in range(0, len(one), 13):
        a, b = one[index], other[index]
        assert a.keys() == b.keys()
        assert all(torch.equal(a[name], b[name]) if torch.is_tensor(a[name]) else a[name] == b[name] for name in a)
    assert not list((tmp_path).glob("*.partial"))
