"""Statistics of pictures by counting: those of NumPy over all pixels; all other numbers are LeRobot's."""

import numpy as np
import pytest

from lerobot_constructskill.demos.pixels import running_statistics
from lerobot_constructskill.lerobot_internals import RunningQuantileStats

QUANTILES = {"q01": 0.01, "q10": 0.1, "q50": 0.5, "q90": 0.9, "q99": 0.99}


@pytest.mark.parametrize("dark", [0, 40])
def test_pixels_are_counted_exactly(dark):
    rng = np.random.default_rng(0)
    pictures = [rng.integers(dark, high, (500, 3), dtype=np.uint8) for high in (200, 90, 256)]
    statistics = running_statistics()()
    for picture in pictures:
        statistics.update(picture)
    found, pixels = statistics.get_statistics(), np.concatenate(pictures).astype(float)
    for name, wanted in (
        ("min", pixels.min(axis=0)),
        ("max", pixels.max(axis=0)),
        ("mean", pixels.mean(axis=0)),
        ("std", pixels.std(axis=0)),
        *((name, np.quantile(pixels, q, axis=0, method="inverted_cdf")) for name, q in QUANTILES.items()),
    ):
        np.testing.assert_allclose(found[name], wanted, err_msg=name)
    assert found["count"].tolist() == [1500] and set(found) == set(lerobots(pixels))


def test_statistics_of_other_numbers_are_lerobots():
    numbers = np.random.default_rng(1).normal(size=(300, 4)).astype(np.float32)
    statistics = running_statistics()()
    statistics.update(numbers)
    found = statistics.get_statistics()
    for name, wanted in lerobots(numbers).items():
        np.testing.assert_array_equal(found[name], wanted)


def lerobots(numbers: np.ndarray) -> dict[str, np.ndarray]:
    statistics = RunningQuantileStats()
    statistics.update(numbers)
    return statistics.get_statistics()
