"""The checking command of a new task."""

import pytest

from lerobot_constructskill.demos.expert import ExpertConfig
from lerobot_constructskill.scripts.expert import CheckTaskConfig, check_task


@pytest.mark.parametrize("bad", [{"task": "lintel"}, {"task": "brick_to_bin", "states": 0}])
def test_bad_input_is_refused(bad):
    with pytest.raises(ValueError, match="lintel|states"):
        check_task(CheckTaskConfig(**bad))


@pytest.mark.sim
def test_a_good_task_is_reported_with_its_interval():
    report = check_task(CheckTaskConfig("block_to_bin", states=2))
    assert "2 of 2" in report and "15.8%" in report


@pytest.mark.sim
def test_an_expert_that_fails_fails_the_check_and_names_the_seeds():
    drops = ExpertConfig(lift_height=0.01, release_clearance=-0.1)
    with pytest.raises(ValueError, match=r"0 of 1 .* seeds \[1000000\]"):
        check_task(CheckTaskConfig("brick_to_bin_turned", states=1, expert=drops))
