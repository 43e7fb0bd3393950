"""DAgger as a user runs it: killed on the way it ends in the same bytes, and its data set is one like any other."""

import hashlib
import json
import os
import shutil
import signal
import subprocess
import sys
import time
from dataclasses import replace

import numpy as np
import pytest
import yaml
from commands import OFFLINE, call
from lerobot.datasets import LeRobotDataset
from lerobot.policies.factory import get_policy_class

from lerobot_constructskill.artifacts.store import Machine, Store
from lerobot_constructskill.dagger import rounds
from lerobot_constructskill.dagger.plan import Plan
from lerobot_constructskill.dagger.rounds import Round
from lerobot_constructskill.dagger.settings import DaggerConfig
from lerobot_constructskill.dataset.card import card_facts, render
from lerobot_constructskill.dataset.checks import CHECKS, complaints
from lerobot_constructskill.dataset.dataset import open_dataset
from lerobot_constructskill.demos.columns import SIDECAR
from lerobot_constructskill.errors import InputError
from lerobot_constructskill.features.node import Features
from lerobot_constructskill.features.trainer import FeatureTrainer
from lerobot_constructskill.parsing import parse

pytestmark = [pytest.mark.sim, pytest.mark.slow]

EPISODES, ROUNDS = 2, 2


@pytest.fixture(scope="module")
def settings(tmp_path_factory, tiny_weights):
    """A configuration file: two demonstrations, two rounds of two short episodes, a policy of random weights."""
    policy = {"type": "frozen_vit", "backbone": "vit_tiny16", "backbone_path": str(tiny_weights)}
    fields = {
        "base": "smoke --annotate=true",
        "policy": policy | {"readout": "heat_maps"},
        "training": {"epochs": 1, "batch_size": 64, "holdout": 2},
        "rounds": ROUNDS,
        "episodes": EPISODES,
        "betas": [0.5, 0.0],
        "max_steps": 15,
    }
    file = tmp_path_factory.mktemp("dagger") / "tiny.yaml"
    file.write_text(yaml.safe_dump(fields))
    return file


@pytest.fixture(scope="module")
def made(settings):
    """The command's root and what it said; the store beside it."""
    root = settings.parent / "whole"
    return root, call("constructskill-dagger", *flags(settings, root, settings.parent / "store"))


def flags(settings, root, store):
    return [str(settings), "--repo_id=local/driven", f"--root={root}", f"--store={store}"]


def test_the_command_tells_of_every_policy_and_leaves_a_set_that_passes_every_check(made):
    root, said = made
    lines = json.loads((root / "rounds.json").read_text())
    assert len(lines) == ROUNDS + 1 and all(f"policy {number}:" in said for number in range(ROUNDS + 1))
    data = open_dataset(root / "dataset")
    assert {name: complaints(data, check) for name, check in CHECKS.items()} == {name: [] for name in CHECKS}
    assert lines[-1]["frames"] == len(data.rows) == lines[0]["frames"] + 15 * EPISODES * ROUNDS
    by_expert = [entry["by_expert"] for entry in data.facts["dagger"]["rounds"]]
    assert 0 < by_expert[0] < 15 * EPISODES and by_expert[1] == 0
    assert "probability of the expert's hand" in render(card_facts(data) | {"repo_id": "local/driven"})


def test_lerobot_reads_the_set_and_the_checkpoint(made):
    root, _ = made
    dataset = LeRobotDataset("local/driven", root=root / "dataset")
    frame = dataset[dataset.num_frames - 1]
    assert int(frame["dagger.round"]) == ROUNDS and frame["dagger.actor"] == "learner"
    assert get_policy_class("frozen_vit").from_pretrained(root / "checkpoint").config.readout == "heat_maps"


@pytest.mark.parametrize("damage", ["rounds", "actor", "label"])
def test_the_checks_see_what_is_not_as_it_is_said_to_be(made, damage):
    data = open_dataset(made[0] / "dataset")
    driven = data.rounds > 0
    if damage == "rounds":
        data.facts["dagger"]["rounds"][0]["frames"] += 1
    elif damage == "actor":
        data.rows["dagger.actor"] = np.where(driven, "nobody", data.rows["dagger.actor"])
    else:
        data.rows["action"] = [a + 0.01 * d for a, d in zip(data.rows["action"], driven, strict=True)]
    assert any(complaints(data, check) for check in CHECKS.values())


@pytest.mark.parametrize("field", ["round", "seed_start", "discarded_seeds", "placed"])
def test_a_record_of_a_round_that_lacks_a_field_is_one_sentence(made, field, tmp_path):
    copy = shutil.copytree(made[0] / "dataset", tmp_path / "copy")
    facts = json.loads((copy / SIDECAR).read_text())
    del facts["dagger"]["rounds"][0][field]
    (copy / SIDECAR).write_text(json.dumps(facts))
    with pytest.raises(InputError, match=rf"constructskill\.json.*{field}"):
        open_dataset(copy)


@pytest.mark.nightly
def test_killed_at_several_stages_it_ends_in_the_same_bytes(made, settings, tmp_path):
    store = tmp_path / "store"
    slowly = [*flags(settings, tmp_path / "set", store), "--workers=1", "--together=1"]
    command = [sys.executable, "-m", "lerobot_constructskill.scripts.dagger", *slowly]
    pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "text": True}
    for stage in ("rounds/*.partial/shards/*/outcome.json", "dagger/*/spec.json"):
        process = subprocess.Popen(command, env=os.environ | OFFLINE, start_new_session=True, **pipes)
        while not list(store.glob(stage)):
            assert process.poll() is None, process.communicate()
            time.sleep(0.05)
        os.killpg(process.pid, signal.SIGKILL)
        process.wait()
        for outcome in [*store.glob("rounds/*.partial/shards/*/outcome.json")][:1]:
            outcome.write_text("")  # as a power cut may leave it
    call("constructskill-dagger", *slowly)
    assert hashes(tmp_path / "set") == hashes(made[0])


def test_a_round_that_stopped_goes_on_with_the_episodes_that_are_whole(made, settings, tmp_path, monkeypatch):
    """The quick one of the test above: both episodes are driven, one is then damaged as a power cut may do it."""
    plan = Plan.of(parse(DaggerConfig, ["--repo_id=local/driven"], settings))
    store = Store(shutil.copytree(settings.parent / "store", tmp_path / "store", symlinks=True))
    (driven,) = plan.round(1)
    folder = store.folder(driven)
    before, asked, drive = hashes(folder), [], Round._drive
    shutil.rmtree(folder)
    order = "meta/stats.json"  # LeRobot lists columns in the order of a set; the whole data set's are sorted

    def stop(*_):
        raise MemoryError

    def note(self, checkpoint, seeds, machine):
        asked.append(list(seeds))
        return drive(self, checkpoint, seeds, machine)

    monkeypatch.setattr(Round, "_drive", note)
    with monkeypatch.context() as patch, pytest.raises(MemoryError):
        patch.setattr(rounds, "aggregate", stop)
        store.get(driven)
    next(tmp_path.rglob(f"{asked[0][0]}/outcome.json")).write_text("")
    store.get(driven)
    both = list(plan.seeds(1))
    assert asked == [both, both[:1]] and hashes(folder) | {order: None} == before | {order: None}


@pytest.mark.parametrize("readout", ["heat_maps", "spatial_softmax"])
def test_joined_features_are_those_of_the_whole_set_encoded(readout, made, settings, tmp_path):
    plan, store = Plan.of(parse(DaggerConfig, ["--repo_id=local/driven"], settings)), Store(settings.parent / "store")
    config = replace(plan.learner.config, readout=readout)
    joined = FeatureTrainer().learns_from(config, plan.data(ROUNDS))
    assert len(joined.of_parts) == 1 + ROUNDS and not store.has(joined), "it is written beside what is trained on it"
    whole = Features(config, plan.data(ROUNDS))
    object.__setattr__(whole, "digest", joined.digest)  # the name of the data set, which its files hold
    inputs = {"demonstrations": store.get(plan.data(ROUNDS))}
    whole.make(tmp_path / "whole", inputs, Machine())
    inputs |= {name: store.get(part) for name, part in joined.inputs.items()}
    joined.make(tmp_path / "joined", inputs, Machine())
    assert hashes(tmp_path / "joined") == hashes(tmp_path / "whole")


def hashes(root):
    files = [path for path in root.rglob("*") if path.is_file() and path.suffix != ".log"]
    return {str(path.relative_to(root)): hashlib.sha256(path.read_bytes()).hexdigest() for path in files}
