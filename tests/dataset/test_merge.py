"""Merging in groups of groups, which keeps the cost of many demonstrations linear, changes no frame."""

import pytest
import torch
from lerobot.datasets import LeRobotDataset
from toy import record_toy

from lerobot_constructskill.demos import merge


@pytest.mark.slow
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
