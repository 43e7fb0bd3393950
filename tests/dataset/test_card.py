"""The card says of a data set what the data say, and the cards that are kept here are what their facts render to."""

import json
import re
import shlex
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import yaml
from commands import call
from PIL import Image
from toy import ToyEnv

from lerobot_constructskill.contract import CAMERAS, FPS, OBS_TYPES, TASKS
from lerobot_constructskill.dataset.card import MEANINGS, card_facts, render
from lerobot_constructskill.dataset.dataset import open_dataset
from lerobot_constructskill.dataset.plots import contact_sheet
from lerobot_constructskill.demos import shards
from lerobot_constructskill.demos.columns import LANGUAGE, SIDECAR, dagger_features, demonstration_features
from lerobot_constructskill.demos.expert import Phase
from lerobot_constructskill.demos.metadata import CONTRACT, file_hashes, modality
from lerobot_constructskill.demos.settings import GenerateConfig
from lerobot_constructskill.errors import InputError
from lerobot_constructskill.interface import describe_task
from lerobot_constructskill.scripts.generate import generate

CARDS = Path(__file__).parents[2] / "datasets_cards"


@pytest.fixture(scope="module")
def data(pristine):
    return open_dataset(pristine)


@pytest.fixture(scope="module")
def card(data):
    return render(card_facts(data))


def test_every_column_of_every_task_has_its_meaning():
    for task in TASKS.values():
        features = dagger_features(task, ["base", "wrist"]) | LANGUAGE
        assert set(features) - {camera.key for camera in CAMERAS.values()} == set(MEANINGS)


@pytest.mark.slow
def test_the_card_counts_what_there_is(card, data):
    rows = data.rows
    assert f"{rows['episode_index'].nunique()} scripted demonstrations ({len(rows)} frames" in card
    assert "10 attempts, 9 succeeded (90.0 %)" in card and "Discarded: seeds 1000002." in card
    assert f"frame rate: {FPS} Hz" in card and "Every eighth is held out: 7." in card
    for phase, count in rows["phase"].value_counts().items():
        assert f"| {phase} | {count} |" in card
    low, high = np.quantile(data.column("action")[:, 0], [0.01, 0.99])
    found = re.search(r"dx (-?[\d.]+) to (-?[\d.]+)", card)
    np.testing.assert_allclose([float(found[1]), float(found[2])], [low, high], atol=1e-3)


@pytest.mark.slow
def test_a_phase_that_no_demonstration_has_is_neither_counted_nor_shown(data, tmp_path):
    without = replace(data, rows=data.rows.assign(phase=data.rows["phase"].replace(Phase.PREGRASP, Phase.DESCEND)))
    card = render(card_facts(without))
    assert f"| {Phase.DESCEND} |" in card and f"| {Phase.PREGRASP} |" not in card and "nan" not in card
    sheets = {name: tmp_path / f"{name}.jpg" for name in ("with", "without")}
    contact_sheet(data, sheets["with"])
    contact_sheet(without, sheets["without"])
    before, after = (np.asarray(Image.open(sheet)).mean(axis=2) for sheet in sheets.values())
    cell = np.s_[before.shape[0] // 6, before.shape[1] // 12 : before.shape[1] // 8]
    assert (after[cell] == 255).all() and not (before[cell] == 255).all()


def test_the_card_of_another_task_evaluates_that_task_and_tells_its_noise(data):
    facts = card_facts(data)
    noise = facts["generator"]["noise"] | {"release_sigma": 0.003}
    card = render(facts | {"generator": facts["generator"] | {"task": "brick_on_brick", "noise": noise}})
    assert card.count("--env.task=brick_on_brick") == 2 and "and 3.0 mm\nin RELEASE while" in card


def test_the_card_says_in_what_unit_an_action_turns(card, data):
    facts = card_facts(data)
    turned = render(facts | {"generator": facts["generator"] | {"task": "brick_to_bin_turned"}})
    assert "turns in rad" in turned and "turns in rad" not in card


def test_every_column_of_the_data_set_is_on_the_card(card, data):
    named = set(re.findall(r"^\| `([\w.]+)` \|", card, re.MULTILINE))
    bookkeeping = {"timestamp", "frame_index", "episode_index", "index", "task_index"}
    assert named == set(data.info["features"]) - bookkeeping


def test_the_front_matter_is_yaml_for_the_hub(card):
    front = yaml.safe_load(card.split("---")[1])
    assert front["license"] == "apache-2.0" and "LeRobot" in front["tags"]


def test_the_training_commands_are_ones_that_lerobot_takes(card):
    commands = re.findall(r"^lerobot-train (?:.*\\\n)*.*$", card, re.MULTILINE)
    assert len(commands) == 4
    for command in commands:
        flags = dict(flag.split("=", 1) for flag in shlex.split(command.replace("\\\n", " "))[1:])
        assert flags["--dataset.repo_id"] == "local/toy"
        mapped = json.loads(flags.get("--rename_map", "{}"))
        assert set(mapped) <= {camera.key for camera in CAMERAS.values()}
        assert ("--policy.path" in flags) == bool(mapped)


def test_the_contract_stands_beside_the_data_and_on_the_card(card, data):
    said = json.loads((data.root / CONTRACT).read_text())
    assert said == describe_task(TASKS["brick_to_bin"], ["base"]) and said["fps"] == data.info["fps"]
    features = data.info["features"]
    for part in (said["action"], said["state"]):
        assert [channel["name"] for channel in part["channels"]] == features[part["key"]]["names"]
    for camera in said["cameras"].values():
        assert [camera["height"], camera["width"]] == list(features[camera["key"]]["shape"])[:2]
    for channel in said["action"]["channels"]:
        assert f"| {channel['name']} | {channel['unit']} | {channel['low']} to {channel['high']} |" in card
    assert "`meta/contract.json`" in card and said["action"]["meaning"] in card


@pytest.mark.parametrize("obs_type", ["pixels", "pixels_agent_pos"])
@pytest.mark.parametrize("task", TASKS)
def test_the_modality_covers_every_channel_once(task, obs_type):
    parts = modality(TASKS[task], OBS_TYPES[obs_type])
    for kind, length in (("state", 8), ("action", len(TASKS[task].action_names))):
        spans = [(part["start"], part["end"]) for part in parts[kind].values()]
        assert [index for start, end in spans for index in range(start, end)] == list(range(length))
    features = demonstration_features(TASKS[task], OBS_TYPES[obs_type])
    assert {video["original_key"] for video in parts["video"].values()} == {n for n in features if "images" in n}


@pytest.mark.slow
def test_the_command_writes_a_card_with_its_pictures(copy, tmp_path):
    call("constructskill-card", f"--root={copy}", "--repo_id=alice/toy", f"--facts={tmp_path / 'facts.json'}")
    card = (copy / "README.md").read_text()
    assert card.startswith("---\n") and "# alice/toy" in card
    assert card == render(json.loads((tmp_path / "facts.json").read_text()))
    for name in re.findall(r"\((pictures/\w+\.png)\)", card):
        assert np.asarray(Image.open(copy / name)).std() > 10


def emptied(root, file, change):
    facts = json.loads((root / file).read_text())
    change(facts)
    (root / file).write_text(json.dumps(facts))


@pytest.mark.parametrize(
    ("file", "change", "said"),
    [
        ("meta/stats.json", lambda stats: stats.update(action=[]), "action: Input should be an object"),
        ("meta/stats.json", lambda stats: stats["action"].update(q01=None), "for each name of action"),
        (
            "meta/stats.json",
            lambda stats: stats["action"].update(q99=[1.0]),
            "for each name of action",
        ),
        ("meta/info.json", lambda info: info["features"]["action"].update(names=None), "for each name of action"),
        (SIDECAR, lambda facts: facts.update(noise_covariance=[]), r"must be 3 x 3, not \[\]"),
    ],
)
def test_a_card_of_metadata_without_its_numbers_is_refused_in_one_sentence(file, change, said, copy):
    emptied(copy, file, change)
    with pytest.raises(InputError, match=said):
        card_facts(open_dataset(copy))


def test_a_set_of_another_packages_task_says_what_its_source_is(copy):
    emptied(copy, SIDECAR, lambda facts: facts["versions"].update(lintel_task="0.1.0, source 2c26b46b68ff"))
    assert "lintel_task 0.1.0, source 2c26b46b68ff" in render(card_facts(open_dataset(copy)))


@pytest.mark.parametrize(
    "folder", sorted(path.parent for path in CARDS.glob("*/README.md")), ids=lambda path: path.name
)
def test_a_kept_card_is_what_its_facts_render_to(folder):
    facts = json.loads((folder / "facts.json").read_text())
    card = (folder / "README.md").read_text()
    assert card == render(facts)
    assert all((folder / name).is_file() for name in re.findall(r"\((pictures/\w+\.png)\)", card))


@pytest.mark.slow
def test_generating_writes_the_card_as_well(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(shards, "_environment", ToyEnv)
    generate(GenerateConfig("local/toy", str(tmp_path / "one"), episodes=1))
    assert "# local/toy" in (tmp_path / "one" / "README.md").read_text()
    monkeypatch.setitem(sys.modules, "jinja2", None)
    generate(GenerateConfig("local/toy", str(tmp_path / "two"), episodes=1))
    assert "No card: jinja2 is not installed; uv pip install" in capsys.readouterr().out
    assert file_hashes(tmp_path / "one") == file_hashes(tmp_path / "two")
