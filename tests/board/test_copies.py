"""Copies are refused, a little changed or under another name; policies that are not copies are far from it."""

import json
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from forge import SEEING, declare, edit

from lerobot_constructskill.board.copies import near_copy
from lerobot_constructskill.board.entries import check_original, read_entries
from lerobot_constructskill.board.protocol import CONTROL, BoardSetting
from lerobot_constructskill.board.submission import Claim, read_submission, write_submission
from lerobot_constructskill.errors import InputError
from lerobot_constructskill.perturbations import PICTURES

ENTRIES = Path(__file__).parents[2] / "board" / "entries"
TASK = "brick_to_bin_shifted"


@pytest.fixture(scope="module")
def entry(tmp_path_factory) -> Path:
    """Two training seeds of a real policy, from two starts."""
    whole = read_submission(ENTRIES / "bins_keypoints")
    setting = BoardSetting(TASK, episodes=2, first_start=5002)
    claims = [
        one
        for one in whole.claims
        if (one.setting, one.training_seed) in ((TASK, 0), (TASK, 1)) and one.evaluation_seed in setting.starts
    ]
    said = whole.declaration
    told = {"about": said.about, "backend": said.backend, "versions": said.versions}
    root = tmp_path_factory.mktemp("copies") / "entry"
    made = write_submission(root, claims, suite="bins", settings={TASK: setting}, training_seeds=[0, 1], **told)
    assert all(one.placed for one in made.claims)
    return root


def last_bit(actions):
    return np.nextafter(actions, np.float32(1), dtype=np.float32)


def by_1e_5(actions):
    return actions + np.float32(1e-5)


def the_gripper_alone(actions):
    is_closed = (np.arange(len(actions)) % 4 == 3) & (actions < 0)
    return np.where(is_closed, np.float32(0.01), actions)


def half_of_the_steps(actions):
    """Others, or the copier would have to search for what ends alike."""
    return np.concatenate([actions[: len(actions) * 4 // 7], actions[len(actions) * 4 // 7 :] + np.float32(0.01)])


@pytest.mark.parametrize("change", [last_bit, by_1e_5, the_gripper_alone, half_of_the_steps, None])
def test_an_entry_under_another_name_is_not_ranked(change, entry, tmp_path):
    for name in ("mine", "yours"):
        shutil.copytree(entry, tmp_path / "entries" / name)
    (tmp_path / "verified").mkdir()
    verdict = {"submission": read_submission(entry).sha256, "level": "replayed", "versions": {}, "date": "2026-11-28"}
    (tmp_path / "verified" / "yours.json").write_text(json.dumps(verdict))
    if change:
        declare(tmp_path / "entries" / "mine", lambda said: said["about"].update(submitter="somebody else"))

        def act(rows):
            for row in rows:
                row["actions"] = change(np.array(row["actions"], np.float32)).tolist()

        edit(tmp_path / "entries" / "mine", act)
    entries, (refused,) = read_entries(tmp_path)
    assert [one.name for one in entries] == ["yours"], "which was verified first"
    assert refused.startswith("Entry 'mine': ") and "the entry yours" in refused
    with pytest.raises(InputError, match="the entry yours"):
        check_original(tmp_path / "entries" / "mine")
    check_original(tmp_path / "entries" / "yours")


def test_the_expert_is_no_ten_training_seeds(tmp_path):
    expert = read_submission(ENTRIES / "bins_expert")
    setting = BoardSetting(TASK, episodes=1)
    (one,) = (claim for claim in expert.claims if (claim.setting, claim.evaluation_seed) == (TASK, 5000))
    claims = [
        Claim(**vars(one) | {"training_seed": seed, "actions": [one.flat + np.float32(seed * 1e-6)]})
        for seed in range(10)
    ]
    told = {"about": replace(expert.declaration.about, observes="pixels"), "backend": SEEING}
    told |= {"suite": "bins", "settings": {TASK: setting}, "versions": expert.declaration.versions}
    with pytest.raises(InputError, match="training seed 0, .* has the actions of .*, training seed 1, .* or nearly"):
        write_submission(tmp_path / "ten", claims, training_seeds=list(range(10)), **told)
    write_submission(tmp_path / "entries" / "one", claims[-1:], training_seeds=[9], **told)
    shutil.copytree(ENTRIES / "bins_expert", tmp_path / "entries" / "expert")
    assert "has the actions of the entry expert" in read_entries(tmp_path)[1][0]


@pytest.mark.slow
def test_what_is_on_the_board_is_far_from_a_copy():
    """Other seeds nearly six times as far as the tolerance, seeds that saw other light more than three times."""
    entries, refused = read_entries(ENTRIES.parent)
    assert not refused
    policies = [entry.submission.claims for entry in entries if not entry.is_reference]
    everything = [claim for claims in policies for claim in claims]
    for claims in policies:
        assert not near_copy(claims, everything, lambda one, other: one.training_seed == other.training_seed, 2.9e-3)
    (perturbed,) = (one.submission.claims for one in entries if one.name == "precise_perturbed")
    control, *others = ([one for one in perturbed if one.setting == name] for name in (CONTROL, *PICTURES))
    for shown in others:
        assert not near_copy(shown, control, lambda *_: False, 1.8e-3)
