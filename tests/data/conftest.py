"""A toy data set of nine demonstrations with one discarded attempt; tests that damage it take a copy."""

import shutil

import pytest
from toy import ToyEnv

from lerobot_constructskill.demos import shards
from lerobot_constructskill.demos.recorder import GenerateConfig, record


@pytest.fixture(scope="session")
def pristine(tmp_path_factory):
    """Root of the toy data set; not to be written to."""
    root = tmp_path_factory.mktemp("toy") / "set"
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(shards, "ConstructSkillEnv", ToyEnv)
        record(GenerateConfig("local/toy", str(root), episodes=9))
    return root


@pytest.fixture
def copy(pristine, tmp_path):
    """A copy of the toy data set, to damage."""
    return shutil.copytree(pristine, tmp_path / "set")
