"""From recordings to a submission: what is missing or was recorded twice is refused, what failed stays counted."""

import json
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import yaml

from lerobot_constructskill.board.declaration import DRAWS, About
from lerobot_constructskill.board.from_recordings import recorded_by_study, recorded_in, submit, with_draws
from lerobot_constructskill.board.protocol import BoardSetting, PublicValue
from lerobot_constructskill.board.rerun import instructions
from lerobot_constructskill.board.submission import read_submission
from lerobot_constructskill.envs.recording import COUNTS, RECORDINGS, Episode, deciding, write_recordings
from lerobot_constructskill.errors import InputError, MissingError
from lerobot_constructskill.scripts.submit import SubmitConfig
from lerobot_constructskill.study.rows import NOT_RUN, ROWS, STUDY, Row, write_rows

CONTROL = BoardSetting("block_to_bin", episodes=2, episode_length=2, first_start=7)
SETTINGS = {"control": CONTROL, "block": replace(CONTROL, perturb="pose=1")}
NOTHING_YET = dict.fromkeys(("is_lifted", "is_in_bin", "is_success"), False) | dict.fromkeys((*COUNTS, "cost"), 0)
BACKEND, VERSIONS = "physx_cpu, sapien_cpu rendering", json.dumps(deciding())
ABOUT = About(*["a test's"] * 7, observes="pixels")


def recording(start, value=0.01, **facts):
    made = {
        "task": "block_to_bin",
        "episode_length": 2,
        "perturb": " pose=1",
        "backend": BACKEND,
        "versions": VERSIONS,
    }
    one = Episode(start, **made | facts)
    for _ in range(2):
        one.add(np.full(4, value), NOTHING_YET)
    return one


@pytest.fixture
def recorded(tmp_path):
    for seed in (0, 3):
        for start in (7, 8, 9):  # one more than is asked for
            for perturb in ("", " pose=1"):
                recording(start, 0.01 * (seed + 1), perturb=perturb).write(tmp_path / "recorded" / f"seed_{seed}")
    recording(7, 0.05, task="brick_to_bin").write(tmp_path / "recorded" / "seed_0")  # another setting's
    return tmp_path / "recorded"


def made(root, piles, failures=()):
    return submit(root, ABOUT, "bins", SETTINGS, piles, dict(failures))


def test_what_was_recorded_becomes_a_submission(recorded, tmp_path):
    submission = made(tmp_path / "made", recorded_in(recorded))
    assert [claim.key for claim in submission.claims] == [
        (name, seed, start) for seed in (0, 3) for name in SETTINGS for start in (7, 8)
    ]
    assert submission.declaration.settings_class == "custom" and submission.declaration.training_seeds == [0, 3]
    assert submission.declaration.backend == BACKEND


def test_a_policy_may_act_in_the_full_action_and_is_run_again_in_it(tmp_path):
    for start in (7, 8):
        for perturb in ("", " pose=1"):
            one = replace(recording(start, perturb=perturb), steps=0, actions=[])
            for _ in range(2):
                one.add(np.full(7, 0.01), NOTHING_YET)
            one.write(tmp_path / "recorded" / "seed_0")
    submission = made(tmp_path / "made", recorded_in(tmp_path / "recorded"))
    assert [claim.environment["action"] for claim in read_submission(tmp_path / "made").claims] == ["full"] * 4
    assert instructions(submission, PublicValue(1, "0" * 64)).count("--env.action=full") == 2


@pytest.mark.parametrize(
    ("name", "said"),
    [
        ("seed_00", "seed_00' is of no training seed"),
        ("seed_99999999999", "seed_99999999999' is of no training seed"),
        ("seed_one", "seed_one' is of no training seed"),
    ],
)
def test_no_folder_of_recordings_is_left_out_without_a_word(name, said, recorded):
    (recorded / name).mkdir()
    with pytest.raises(InputError, match=said):
        recorded_in(recorded)


def test_a_recording_is_one_however_its_ending_is_written(recorded):
    before = len(recorded_in(recorded)[0])
    next((recorded / "seed_0").glob("*.parquet")).rename(recorded / "seed_0" / "x.PARQUET")
    assert len(recorded_in(recorded)[0]) == before


def test_what_a_killed_process_left_is_not_read(recorded, tmp_path):
    (recorded / "seed_0" / ".host-1.block_to_bin-7.parquet").write_bytes(b"PAR1")
    assert len(made(tmp_path / "made", recorded_in(recorded)).claims) == 8


def test_a_missing_episode_is_refused_unless_its_run_failed(recorded, tmp_path):
    for path in (recorded / "seed_3").glob("*pose*-8-*"):
        path.unlink()
    with pytest.raises(InputError, match="block, training seed 3, start 8 was not recorded"):
        made(tmp_path / "made", recorded_in(recorded))
    assert not (tmp_path / "made").exists()
    elsewhere = {name: replace(setting, first_start=40) for name, setting in SETTINGS.items()}
    with pytest.raises(InputError, match="starts 7 to 9 were, and 40 to 41 are asked for; for other starts give"):
        submit(tmp_path / "made", ABOUT, "bins", elsewhere, recorded_in(recorded), {})
    longer = {name: replace(setting, episode_length=400) for name, setting in SETTINGS.items()}
    with pytest.raises(InputError, match="seed 0, was recorded with at most 2 steps an episode, not 400: evaluate it"):
        submit(tmp_path / "made", ABOUT, "bins", longer, recorded_in(recorded), {})
    submission = made(tmp_path / "made", recorded_in(recorded), {3: "out of memory", 5: "diverged"})
    failed = {claim.key: claim.error for claim in submission.claims if claim.error}
    diverged = dict.fromkeys([(name, 5, start) for name in SETTINGS for start in (7, 8)], "diverged")
    assert failed == {("block", 3, 8): "out of memory"} | diverged


def test_what_does_not_belong_together_is_refused(recorded, tmp_path):
    recording(7, 0.05).write(recorded / "seed_3")
    with pytest.raises(InputError, match="start 7 was recorded twice, with different actions"):
        made(tmp_path / "made", recorded_in(recorded))
    with pytest.raises(InputError, match="several backends"):
        piles = {0: [recording(start, perturb=perturb) for start in (7, 8) for perturb in ("", "pose=1")]}
        piles[0][-1].backend = "physx_cuda, gpu rendering"
        made(tmp_path / "made", piles)
    with pytest.raises(InputError, match="was shown pixels"):
        piles = {0: [recording(7, obs_type="pixels")]}
        submit(
            tmp_path / "made", replace(ABOUT, observes="pixels_agent_pos"), "bins", SETTINGS, piles, {0: "diverged"}
        )
    with pytest.raises(InputError, match="Nothing was recorded"):
        made(tmp_path / "made", {}, {0: "diverged"})
    with pytest.raises(MissingError, match="seed_0"):
        recorded_in(tmp_path / "nowhere")


def test_what_is_not_in_a_submission_may_have_been_recorded_elsewhere(recorded, tmp_path):
    recording(9, 0.02, backend="physx_cuda, gpu rendering").write(recorded / "seed_0" / "fresh")
    recording(7, task="brick_to_bin", versions="{}").write(recorded / "seed_0")
    assert made(tmp_path / "made", recorded_in(recorded)).declaration.backend == BACKEND


FACTS = {
    "setting": "block",
    "variant": "ours",
    "role": "variant",
    "episodes": 2,
    "training_seed": 0,
    "evaluation_seed": 7,
    "episode": 0,
}


@pytest.fixture
def study(tmp_path):
    """Four settings, of which one evaluates as a submission's does."""
    here = {"task": "block_to_bin", "episode_length": 2}
    envs = {
        "block": here,
        "brick": here | {"task": "brick_to_bin"},
        "long": {"task": "block_to_bin"},
        "moved": here | {"perturb": "pose=2"},
    }
    settings = {name: {"env": env} for name, env in envs.items()}
    (tmp_path / "study").mkdir()
    (tmp_path / "study" / STUDY).write_text(yaml.safe_dump({"name": "study", "settings": settings}))
    return tmp_path / "study"


def made_of_study(root, piles, failures):
    return submit(root, ABOUT, "bins", {"block": CONTROL}, piles, failures)


def test_a_studys_runs_become_a_submission(study, tmp_path):
    rows, store = [], tmp_path / "store"
    for seed in range(2):
        ran = [recording(start, 0.01 * (seed + 1), perturb="") for start in (7, 8)]
        write_recordings(ran, store / "runs" / f"d{seed}" / RECORDINGS)
        for episode in range(2):
            start = {"training_seed": seed, "evaluation_seed": 7 + episode, "episode": episode}
            rows.append(Row(run=f"d{seed}", **FACTS | start))
    rows.append(Row(run="d2", **FACTS | {"training_seed": 2}, error_kind="fault", error="lost\nthe plot"))
    for elsewhere in ("brick", "long", "moved"):  # these are not asked for
        rows.append(Row(run="d3", **FACTS | {"setting": elsewhere}, error_kind=NOT_RUN))
    write_rows(rows, study / ROWS)
    piles, failures = recorded_by_study(study, store, "ours", {"block": CONTROL})
    assert {seed: len(pile) for seed, pile in piles.items()} == {0: 2, 1: 2, 2: 0} and failures == {2: "lost the plot"}
    assert len(made_of_study(tmp_path / "made", piles, failures).claims) == 6


def test_two_settings_of_a_study_that_evaluate_alike_are_never_mixed(study, tmp_path):
    """A run that failed in one would be hidden by the one that finished in the other."""
    said = yaml.safe_load((study / STUDY).read_text())
    said["settings"]["again"] = said["settings"]["block"]
    (study / STUDY).write_text(yaml.safe_dump(said))
    store = tmp_path / "store"
    write_recordings([recording(start, perturb="") for start in (7, 8)], store / "runs" / "d1" / RECORDINGS)
    failed = Row(run="d0", **FACTS, error_kind="fault", error="lost")
    write_rows(
        [failed, *(Row(run="d1", **FACTS | {"setting": "again", "episode": one}) for one in (0, 1))], study / ROWS
    )
    with pytest.raises(InputError, match=r"evaluate alike \(block, again\): .* --study_settings=\[again\]"):
        recorded_by_study(study, store, "ours", {"block": CONTROL})
    assert recorded_by_study(study, store, "ours", {"block": CONTROL}, ["block"])[1] == {0: "lost"}
    piles, failures = recorded_by_study(study, store, "ours", {"block": CONTROL}, ["again"])
    assert len(piles[0]) == 2 and not failures
    with pytest.raises(InputError, match="has no setting 'nowhere'; it has: again, block"):
        recorded_by_study(study, store, "ours", {"block": CONTROL}, ["nowhere"])


def test_what_training_seeds_learnt_from_is_said_by_their_study(study):
    assert (ABOUT.draws, with_draws(ABOUT, study).draws) == ("draws of demonstrations not said", DRAWS["shared"])
    said = yaml.safe_load((study / STUDY).read_text()) | {"demonstrations": "own"}
    (study / STUDY).write_text(yaml.safe_dump(said))
    assert with_draws(replace(ABOUT, demonstrations="own"), study).draws == DRAWS["own"]
    with pytest.raises(InputError, match="demonstrations is shared, but those of the study are own"):
        with_draws(replace(ABOUT, demonstrations="shared"), study)
    with pytest.raises(InputError, match="2 training seeds share a draw of demonstrations"):
        (study / STUDY).write_text(yaml.safe_dump(said | {"seeds_a_draw": 2}))
        with_draws(ABOUT, study)
    (study / STUDY).write_text(yaml.safe_dump(said))
    expert = replace(ABOUT, observes="privileged")
    assert with_draws(expert, study) == expert and not expert.draws


def test_what_a_study_does_not_have_is_said(study, tmp_path):
    def collected(row, variant="ours", setting=CONTROL):
        write_rows([row], study / ROWS)
        return recorded_by_study(study, tmp_path / "store", variant, {"one": setting})

    row = Row(run="d9", **FACTS)
    with pytest.raises(InputError, match="it has: ours"):
        collected(row, "theirs")
    for other in (
        BoardSetting("tile_to_grid"),
        replace(CONTROL, episode_length=3),
        replace(CONTROL, perturb="pose=3"),
    ):
        with pytest.raises(InputError, match=r"in none of .*, but in block_to_bin \(2 steps\)"):
            collected(row, setting=other)
    with pytest.raises(MissingError, match="before actions were kept"):
        collected(row)
    with pytest.raises(MissingError, match="not run block/ours/seed_0 yet"):
        collected(Row(run="d9", **FACTS, error_kind=NOT_RUN))
    (study / STUDY).write_text("settings: {block: {}}")
    with pytest.raises(InputError, match="is not a study's file: settings.block.env: it is missing"):
        collected(row)
    (study / STUDY).write_text("settings: {block: {env: {}}}")
    with pytest.raises(InputError, match="is not a study's file: settings.block.env.task: it is missing"):
        collected(row)
    (study / STUDY).unlink()
    with pytest.raises(MissingError, match="study.yaml is missing"):
        collected(row)


@pytest.mark.parametrize(
    ("fields", "said"),
    [
        ({}, "Give what the submission is made from: --recorded, or --study with --variant."),
        ({"recorded": Path("r"), "study": Path("s"), "variant": "ours"}, "Give what the submission is made from"),
        ({"study": Path("s")}, "--study with --variant"),
        ({"recorded": Path("r"), "study_settings": ["block"]}, "study_settings are of --study."),
        (
            {"recorded": Path("r"), "failures": {"-1": "lost"}},
            "failures must map training seeds to reasons, not '-1'.",
        ),
    ],
    ids=str,
)
def test_a_submission_of_what_does_not_belong_together_is_refused(fields, said):
    with pytest.raises(InputError, match=re.escape(said)):
        SubmitConfig("bins", Path("about.yaml"), Path("entry"), **fields)
