"""`make release`: what goes to the Hub is written, and uploaded to a Hub on loopback that speaks the protocol."""

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
from hub_server import TOKENS, serve

from lerobot_constructskill.artifacts.store import Store
from lerobot_constructskill.lerobot_internals import load_plugins
from lerobot_constructskill.parsing import parse
from lerobot_constructskill.presets import find
from lerobot_constructskill.scripts.study import StudyConfig
from lerobot_constructskill.study.plan import list_runs
from lerobot_constructskill.training.checkpoints import checkpoint_of

pytestmark = pytest.mark.nightly  # what it calls, `push_dataset` above all, is tested by itself

RESULTS = Path(__file__).parents[2] / "results"

FEWER = """
import sys
sys.path.insert(0, sys.argv.pop(1))
import release
release.SETS = ("fast",)
release.main()
"""
"""The script with one data set: to make the others takes half an hour."""


def seventh(store):
    """A folder for the checkpoint of training seed 7, as `make results` would leave it, but for its weights."""
    load_plugins()
    study = parse(StudyConfig, [], find("study", "precise")).study
    run = next(run for run in list_runs(study) if run.id == "brick_to_bin_shifted/precise/seed_7")
    with store.claim([run.checkpoints]), store.writing(run.checkpoints) as folder:
        own = checkpoint_of(7, folder)
        own.mkdir(parents=True)
        (own / "config.json").write_text('{"type": "frozen_vit"}')
        (own / "model.safetensors").write_bytes(b"weights")


def test_a_release_is_written_and_pushed(demonstrations, tmp_path):
    out, site = tmp_path / "hub", tmp_path / "site"
    site.mkdir()
    (site / "index.html").write_text("the board")
    shutil.copytree(demonstrations, out / "datasets" / "constructskill_fast")
    seventh(Store(tmp_path / "store"))
    with serve() as hub:
        env = {**os.environ, "HF_ENDPOINT": hub.url, "HF_HOME": str(tmp_path / "home"), "HF_TOKEN": next(iter(TOKENS))}
        env |= {"HF_HUB_DISABLE_XET": "1", "HF_HUB_OFFLINE": "0"}
        where = [f"--out={out}", f"--site={site}", f"--store={tmp_path / 'store'}"]
        command = [sys.executable, "-c", FEWER, str(RESULTS), "--user=alice", "--push", *where]
        told = subprocess.run(command, env=env, capture_output=True, text=True, check=False)
        assert not told.returncode, told.stderr
    assert "9 of 10 checkpoints of precise/brick_to_bin_shifted/precise are not in" in told.stdout
    policy = "models/alice/constructskill_precise_brick_to_bin_shifted_precise_seed_7"
    assert {*hub.repos} == {"datasets/alice/constructskill_fast", "spaces/alice/constructskill", policy}
    held = {name: repo.commits[repo.branches["main"]] for name, repo in hub.repos.items()}
    assert hub.blobs[held["spaces/alice/constructskill"]["index.html"][0]] == b"the board"
    assert "sdk: static" in hub.blobs[held["spaces/alice/constructskill"]["README.md"][0]].decode()
    card = hub.blobs[held[policy]["README.md"][0]].decode()
    assert "| 7 (this one) | " in card and card.count("/50 |") == 20, "lifted and placed of all ten seeds"
    assert "Trained on `alice/constructskill_precise_brick_to_bin_shifted`" in card
    assert {"v3.0", "v0.1.0"} <= {*hub.repos["datasets/alice/constructskill_fast"].tags}
