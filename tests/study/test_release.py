"""`make release`: what goes to the Hub is written, and uploaded to a Hub on loopback that speaks the protocol."""

import json
import os
import subprocess
import sys
from importlib.metadata import version
from pathlib import Path

import pytest
from hub_server import TOKENS, serve

import lerobot_constructskill.plugin  # noqa: F401
from lerobot_constructskill.artifacts.store import Machine, Store
from lerobot_constructskill.errors import InputError, MissingError, TakenError
from lerobot_constructskill.study.rows import ROWS, read_rows

pytestmark = pytest.mark.nightly

RESULTS = Path(__file__).parents[2] / "results"

TAG = f"v{version('lerobot_env_constructskill')}"


@pytest.fixture
def release(monkeypatch):
    """The script with one small study's worth of work: to train ten seeds takes half an hour."""
    monkeypatch.syspath_prepend(str(RESULTS))
    import release

    monkeypatch.setattr(release, "SETS", ())
    monkeypatch.setattr(release, "Maker", lambda *_: Made())
    return release


class Made:
    """A `Maker` with so many runs to make of each piece; computing those of all studies takes half a minute."""

    left = {"one": 0, "two": 0}
    every = tuple(left)

    def due(self, pieces):
        return ((piece, ["a run"] * self.left[piece]) for piece in pieces)


@pytest.fixture
def write(release, demonstrations, tmp_path, monkeypatch):
    """Write a release; what the store has is made up, but for the data set."""
    checkpoints, site = tmp_path / "checkpoints", tmp_path / "site"
    site.mkdir()
    (site / "index.html").write_text("the board")
    for seed in range(10):
        (checkpoints / f"seed_{seed}").mkdir(parents=True)
        (checkpoints / f"seed_{seed}" / "config.json").write_text('{"type": "frozen_vit"}')
        (checkpoints / f"seed_{seed}" / "model.safetensors").write_bytes(b"%d" % seed)
        (checkpoints / f"seed_{seed}" / "log.txt").write_text("no part of it")
    monkeypatch.setattr(
        Store, "get", lambda store, node, machine: demonstrations if node.kind == "demonstrations" else checkpoints
    )
    return lambda out, **options: release.write(out, "alice", Store(tmp_path / "store"), site, Machine(), **options)


@pytest.fixture
def as_published(release, monkeypatch):
    """Weights have the hashes of the published rows."""
    rows = read_rows(RESULTS / "precise" / ROWS)
    own = rows[(rows["setting"] == "brick_to_bin_shifted") & (rows["variant"] == "precise")]
    published = dict(zip(own["training_seed"], own["weights_sha256"], strict=True))
    monkeypatch.setattr(release, "file_sha256", lambda path: published[int(path.read_text())])


def test_weights_that_the_rows_are_not_of_are_refused_and_nothing_is_left(write, tmp_path):
    with pytest.raises(
        InputError, match="precise/brick_to_bin_shifted/precise/seed_0 here are not those of the publish"
    ):
        write(tmp_path / "hub")
    assert not (tmp_path / "hub").exists()


def test_results_that_are_missing_are_in_no_release(write, as_published, tmp_path, release, monkeypatch):
    monkeypatch.setattr(Made, "left", {"one": 0, "two": 3})
    with pytest.raises(InputError, match="The results lack 1 piece, or have them of older"):
        write(tmp_path / "hub")
    write(tmp_path / "hub", draft=True)
    with pytest.raises(InputError, match="holds a draft"):
        release.push(tmp_path / "hub")


def test_what_is_no_release_stays(write, as_published, tmp_path, release):
    (tmp_path / "hub").mkdir()
    with pytest.raises(TakenError, match="exists already"):
        write(tmp_path / "hub")
    with pytest.raises(MissingError, match="holds no release"):
        release.push(tmp_path / "hub")


def test_a_release_is_pushed_once_and_the_next_version_takes_its_place(write, as_published, tmp_path):
    out = tmp_path / "hub"
    write(out)
    (out / "models" / "of_yesterday").mkdir()
    write(out)
    with serve() as hub:
        env = {**os.environ, "HF_ENDPOINT": hub.url, "HF_HOME": str(tmp_path / "home"), "HF_TOKEN": next(iter(TOKENS))}
        env |= {"HF_HUB_DISABLE_XET": "1", "HF_HUB_OFFLINE": "0"}

        def push() -> str:
            command = [sys.executable, str(RESULTS / "release.py"), "--push", f"--out={out}"]
            told = subprocess.run(command, env=env, capture_output=True, text=True, check=False)
            assert not told.returncode, told.stderr
            return told.stdout

        assert push().count("Pushed: alice/") == 12
        held = {name: repo.commits[repo.branches["main"]] for name, repo in hub.repos.items()}
        again = push()
        assert again.count(f"holds {TAG} already") == 12 and "Pushed" not in again
        (out / "release.json").write_text(json.dumps({"user": "alice", "tag": "v99", "draft": False}))
        data = hub.repos["datasets/alice/constructskill_precise_brick_to_bin_shifted"].tags
        told = push()
        del data["v99"]  # as a kill between LeRobot's tag and the release's leaves it
        assert told.count("Pushed: alice/") == 12 and push().count("Pushed: alice/") == 1
        assert all(repo.tags.keys() >= {TAG, "v99"} for repo in hub.repos.values())
        assert all(repo.tags["v99"] == repo.branches["main"] for repo in hub.repos.values())
    policies = [f"models/alice/constructskill_precise_brick_to_bin_shifted_precise_seed_{seed}" for seed in range(10)]
    data = "datasets/alice/constructskill_precise_brick_to_bin_shifted"
    assert {*hub.repos} == {data, "spaces/alice/constructskill", *policies}
    assert hub.blobs[held["spaces/alice/constructskill"]["index.html"][0]] == b"the board"
    assert "sdk: static" in hub.blobs[held["spaces/alice/constructskill"]["README.md"][0]].decode()
    assert {*held[policies[7]]} == {"README.md", "config.json", "model.safetensors"}
    card = hub.blobs[held[policies[7]]["README.md"][0]].decode()
    assert "| 7 (this one) | " in card and card.count("/50 |") == 20, "lifted and placed of all ten seeds"
    assert f"Trained on `alice/constructskill_precise_brick_to_bin_shifted`, revision `{TAG}`" in card
    assert "--env.episode_length=300 --seed=5000 --eval.n_episodes=50" in card and "Space `alice/construct" in card
