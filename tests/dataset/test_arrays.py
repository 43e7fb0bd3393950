"""The page's way from a data set to arrays, without LeRobot, leads to what LeRobot reads."""

import re
from pathlib import Path

import numpy as np
import pytest
from lerobot.datasets import LeRobotDataset

pytestmark = pytest.mark.slow

PAGE = Path(__file__).parents[2] / "docs" / "data_sets.md"


def test_the_arrays_of_the_page_are_what_lerobot_reads(pristine, capsys):
    (code,) = re.findall(r"^```python\n(.*?)^```$", PAGE.read_text(), re.MULTILINE | re.DOTALL)
    assert len(code.strip().splitlines()) <= 25
    for number in (0, 5):  # one in the middle of its video file
        names: dict = {}
        code_of_one = code.replace("outputs/shifted/demonstrations", str(pristine)).replace(
            "slice(0, 1)", f"slice({number}, 1)"
        )
        exec(code_of_one, names)
        arrays, first = names["arrays"], names["first"]
        dataset = LeRobotDataset("local/toy", root=pristine)
        assert len(arrays["action"]) == dataset.meta.episodes[number]["length"]
        for step in (0, 17, len(arrays["action"]) - 1):
            item = dataset[first + step]
            for name in ("action", "sim.joint_positions", "next.reward", "timestamp"):
                np.testing.assert_array_equal(
                    arrays[name][step].astype(np.float32).reshape(-1), item[name].reshape(-1)
                )
            seen = (item["observation.images.base"] * 255).round().permute(1, 2, 0)
            np.testing.assert_array_equal(arrays["observation.images.base"][step], seen)
    printed = capsys.readouterr().out
    assert "sim.joint_velocities" in printed and "'panda_joint7'" in printed and "'qw'" in printed
