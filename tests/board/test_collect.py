"""From recordings to a submission: what is missing or was recorded twice is refused, what failed stays counted."""

import numpy as np
import pytest

from lerobot_constructskill.board.collect import of_study, recorded_in, submit
from lerobot_constructskill.board.protocol import Setting
from lerobot_constructskill.board.submission import About
from lerobot_constructskill.envs.recording import RECORDINGS, Recording, write_recordings
from lerobot_constructskill.errors import InputError, MissingError
from lerobot_constructskill.study.rows import NOT_RUN, ROWS, Row, write_rows

SETTINGS = {"block": Setting("block_to_bin", episodes=2, episode_length=2, first_start=7, perturb="pose=1")}
ABOUT = About(*["a test's"] * 7, observes="pixels")


def recording(start, value=0.01, **facts):
    made = {"task": "block_to_bin", "episode_length": 2, "perturb": " pose=1", "backend": "physx_cpu, none rendering"}
    one = Recording(start, **made | facts)
    for _ in range(2):
        one.add(np.full(4, value), {"is_lifted": False, "is_in_bin": False, "is_success": False})
    return one


@pytest.fixture
def recorded(tmp_path):
    for seed in (0, 3):
        for start in (7, 8, 9):  # one more than is asked for
            recording(start, 0.01 * (seed + 1)).write(tmp_path / "recorded" / f"seed_{seed}")
    recording(7, perturb="").write(tmp_path / "recorded" / "seed_0")  # another setting's
    return tmp_path / "recorded"


def made(root, piles, failures=()):
    return submit(root, ABOUT, "bins", SETTINGS, piles, dict(failures))


def test_what_was_recorded_becomes_a_submission(recorded, tmp_path):
    submission = made(tmp_path / "made", recorded_in(recorded))
    assert [claim.key for claim in submission.claims] == [
        ("block", seed, start) for seed in (0, 3) for start in (7, 8)
    ]
    assert submission.declaration.settings_class == "custom" and submission.declaration.training_seeds == [0, 3]
    assert submission.declaration.backend == "physx_cpu, none rendering"


def test_a_missing_episode_is_refused_unless_its_run_failed(recorded, tmp_path):
    for path in (recorded / "seed_3").glob("*-8-*"):
        path.unlink()
    with pytest.raises(InputError, match="block, training seed 3, start 8 was not recorded"):
        made(tmp_path / "made", recorded_in(recorded))
    assert not (tmp_path / "made").exists()
    submission = made(tmp_path / "made", recorded_in(recorded), {3: "out of memory", 5: "diverged"})
    failed = {claim.key[1:]: claim.error for claim in submission.claims if claim.error}
    assert failed == {(3, 8): "out of memory", (5, 7): "diverged", (5, 8): "diverged"}


def test_what_does_not_belong_together_is_refused(recorded, tmp_path):
    recording(7, 0.05).write(recorded / "seed_3")
    with pytest.raises(InputError, match="start 7 was recorded twice, with different actions"):
        made(tmp_path / "made", recorded_in(recorded))
    with pytest.raises(InputError, match="several backends"):
        piles = {0: [recording(7), recording(8, backend="physx_cuda, gpu rendering")]}
        made(tmp_path / "made", piles)
    with pytest.raises(InputError, match="Nothing was recorded"):
        made(tmp_path / "made", {}, {0: "diverged"})
    with pytest.raises(MissingError, match="seed_0"):
        recorded_in(tmp_path / "nowhere")


def test_a_studys_runs_become_a_submission(tmp_path):
    rows, store = [], tmp_path / "store"
    facts = {"setting": "block", "variant": "ours", "role": "variant", "episodes": 2}
    for seed in range(2):
        write_recordings([recording(7, 0.01 * (seed + 1)), recording(8)], store / "runs" / f"d{seed}" / RECORDINGS)
        for episode in range(2):
            rows.append(Row(run=f"d{seed}", training_seed=seed, evaluation_seed=7 + episode, episode=episode, **facts))
    failed = {"run": "d2", "training_seed": 2, "evaluation_seed": 7, "episode": 0, **facts}
    write_rows([*rows, Row(**failed, error_kind="fault", error="lost\nthe plot")], tmp_path / "study" / ROWS)
    piles, failures = of_study(tmp_path / "study", store, "ours")
    assert {seed: len(pile) for seed, pile in piles.items()} == {0: 2, 1: 2, 2: 0} and failures == {2: "lost the plot"}
    assert len(made(tmp_path / "made", piles, failures).claims) == 6

    with pytest.raises(InputError, match="it has: ours"):
        of_study(tmp_path / "study", store, "theirs")
    write_rows([Row(**failed, error_kind=NOT_RUN)], tmp_path / "study" / ROWS)
    with pytest.raises(MissingError, match="not run block/ours/seed_2 yet"):
        of_study(tmp_path / "study", store, "ours")
    write_rows([Row(**failed | {"run": "d9"})], tmp_path / "study" / ROWS)
    with pytest.raises(MissingError, match="before actions were kept"):
        of_study(tmp_path / "study", store, "ours")
