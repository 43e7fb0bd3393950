"""A training that ends from outside is no result of a policy."""

import sys
from pathlib import Path
from types import SimpleNamespace

import pytest

from lerobot_constructskill.artifacts import disk
from lerobot_constructskill.artifacts.store import Artifact, Store
from lerobot_constructskill.errors import MachineError
from lerobot_constructskill.training.checkpoints import writing_checkpoint
from lerobot_constructskill.training.trainers import _call


@pytest.mark.parametrize("signal", ["SIGKILL", "SIGTERM"])
def test_a_training_that_was_killed_is_the_machines_doing(signal):
    ending = f"import os, signal; os.kill(os.getpid(), signal.{signal})"
    with pytest.raises(MachineError, match=rf"was killed \({signal}\)"):
        _call([sys.executable, "-c", ending])


@pytest.mark.parametrize(
    "ending, said", [("print('lost'); exit(3)", "status 3 .* lost"), ("import os; os.abort()", "status -6")]
)
def test_a_training_that_ends_itself_is_the_policys_doing(ending, said):
    with pytest.raises(RuntimeError, match=said):
        _call([sys.executable, "-c", ending])


def test_a_checkpoint_that_finds_no_room_is_the_machines_doing(tmp_path: Path, monkeypatch):
    """Stands in for the disk: a real one would have to be filled."""
    store, made = Store(tmp_path), Artifact("checkpoints", {"of": "a policy"})
    full = pytest.raises(MachineError, match="is full")
    with store.claim([made]), full, writing_checkpoint(store, made) as folder:
        folder.mkdir()
        monkeypatch.setattr(disk.shutil, "disk_usage", lambda path: SimpleNamespace(free=0))
        raise RuntimeError("SafetensorError: os error 28")
    monkeypatch.undo()
    assert not store.has(made)
