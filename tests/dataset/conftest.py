"""A toy data set of nine demonstrations with one discarded attempt; tests that damage it take a copy."""

import shutil

import pytest
from toy import record_toy


@pytest.fixture(scope="session")
def pristine(tmp_path_factory):
    """Root of the toy data set; not to be written to."""
    root = tmp_path_factory.mktemp("toy") / "set"
    record_toy(root, episodes=9)
    return root


@pytest.fixture
def copy(pristine, tmp_path):
    """A copy of the toy data set, to damage."""
    return shutil.copytree(pristine, tmp_path / "set")
