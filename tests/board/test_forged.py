"""Two hundred forged submissions and more: none passes, none crashes, each gets one sentence."""

import shutil

import numpy as np
import pytest
from forge import READ, REPLAYED

from lerobot_constructskill.board.replay import difference, open_simulator
from lerobot_constructskill.board.submission import SCORES, read_submission
from lerobot_constructskill.errors import UserError

COSTLY = ("a_bomb_of_rows", "a_bomb_of_actions", "a_bomb_of_text")
TIMES, TIMES_COSTLY, TIMES_REPLAYED = 6, 1, 3


def forged(valid, tmp_path, forge, number):
    root = tmp_path / str(number)
    shutil.copytree(valid, root)
    forge(root, np.random.default_rng(number))
    return root


def test_the_valid_one_is_opened(valid):
    submission = read_submission(valid)
    assert len(submission.claims) == 8 and sum(claim.placed for claim in submission.claims) == 4
    assert submission.declaration.settings_class == "custom"


@pytest.mark.parametrize(
    "kind", [pytest.param(kind, marks=pytest.mark.slow if kind in COSTLY else ()) for kind in READ]
)
def test_what_is_wrong_with_it_is_seen_when_it_is_opened(kind, valid, tmp_path):
    for number in range(TIMES_COSTLY if kind in COSTLY else TIMES):
        root = forged(valid, tmp_path, READ[kind], number)
        with pytest.raises(UserError) as refusal:
            read_submission(root)
        said = str(refusal.value)
        assert said and "\n" not in said and len(said) < 500 and said.isprintable(), said


@pytest.mark.sim
@pytest.mark.slow
def test_what_is_wrong_with_it_is_seen_when_it_is_replayed(valid, tmp_path):
    before, envs = {claim.key: claim for claim in read_submission(valid).claims}, {}
    for kind, forge in REPLAYED.items():
        for number in range(TIMES_REPLAYED):
            submission = read_submission(forged(valid, tmp_path / kind, forge, number))
            changed = [claim for claim in submission.claims if is_other(claim, before.get(claim.key))]
            for claim in changed or submission.claims[:1]:
                environment = claim.environment
                key = repr(environment)
                envs[key] = envs.get(key) or open_simulator(environment)
                said = difference(envs[key], claim)
                assert said and "\n" not in said, f"{kind} {number} passes"
    for env in envs.values():
        env.close()


def is_other(one, other):
    scores = ([getattr(claim, name) for name in SCORES] for claim in (one, other or one))
    is_same = other and one.outcome == other.outcome and next(scores) == next(scores)
    return not is_same or not np.array_equal(one.flat, other.flat)
