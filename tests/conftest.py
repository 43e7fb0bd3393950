"""The order of the tests, and their garbage."""

import gc

import pytest


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Files that take long are dealt out first: a worker that got one last would work on alone."""
    weights = {}
    for item in items:
        weight = 2 * bool(item.get_closest_marker("slow")) + bool(item.get_closest_marker("sim"))
        weights[item.path] = max(weight, weights.get(item.path, 0))
    items.sort(key=lambda item: -weights[item.path])


def pytest_collection_finish() -> None:
    """What the tests import stays: the collector need not look at LeRobot's million objects again and again."""
    gc.collect()
    gc.freeze()
