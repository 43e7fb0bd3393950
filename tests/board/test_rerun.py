"""A re-run confirms what fresh starts can, and nothing that they cannot."""

import re
from dataclasses import replace

import numpy as np
import pytest
import yaml

from lerobot_constructskill.board.declaration import MOST_SETTINGS
from lerobot_constructskill.board.protocol import BoardSetting, PublicValue, fresh_settings, fresh_start
from lerobot_constructskill.board.rerun import check_later, compare_rerun, instructions
from lerobot_constructskill.board.submission import Claim, Submission, read_submission
from lerobot_constructskill.errors import InputError

STARTS, VALUE = 50, PublicValue(1, "ab" * 32)


@pytest.fixture(scope="module")
def submission(valid) -> Submission:
    """A submission of two training seeds that places from every start of its two settings."""
    whole = read_submission(valid)
    settings = {name: replace(one, episodes=STARTS) for name, one in whole.declaration.settings.items()}
    return replace(whole, declaration=replace(whole.declaration, settings=settings), claims=claims(settings, 1.0))


def claims(settings, rate: float, seed: int = 0) -> list[Claim]:
    """Both training seeds place from the same share of starts, drawn at random."""
    rng = np.random.default_rng(seed)
    return [
        Claim(start, placed=bool(success), setting=name, training_seed=training_seed)
        for name, one in settings.items()
        for start, success in zip(one.starts, rng.random(one.episodes) < rate, strict=True)
        for training_seed in (0, 1)
    ]


def rerun(submission: Submission, rate: float, seed: int = 0) -> Submission:
    settings = fresh_settings(submission.declaration.settings, fresh_start(submission.sha256, VALUE))
    declaration = replace(submission.declaration, settings=settings)
    return replace(submission, declaration=declaration, claims=claims(settings, rate, seed))


def test_what_only_works_on_public_starts_is_not_confirmed(submission):
    compare_rerun(submission, rerun(submission, 1.0), VALUE)
    assert worse(submission, rerun(submission, 0.5)) == set(submission.declaration.settings)


def worse(submission: Submission, again: Submission) -> set[str]:
    """The settings in which a re-run is refused."""
    try:
        compare_rerun(submission, again, VALUE)
    except InputError as error:
        told = str(error).removeprefix("The second time does not confirm it: ")
        return set(re.findall(r"(\S+) \d+% submitted, \d+% run anew \(p = ", told))
    return set()


def test_seeds_are_the_same_in_any_order_and_a_draw_is_told(submission):
    again = rerun(submission, 1.0)
    seeds = replace(again.declaration, training_seeds=again.declaration.training_seeds[::-1])
    compare_rerun(submission, replace(again, declaration=seeds), VALUE)
    with pytest.raises(InputError, match="training seeds"):
        compare_rerun(submission, replace(again, declaration=replace(seeds, training_seeds=[0])), VALUE)
    settings = {"on": BoardSetting("block_to_bin", perturb_seed=5)}
    told = instructions(replace(submission, declaration=replace(submission.declaration, settings=settings)), VALUE)
    (said,) = [yaml.safe_load(line) for line in told.splitlines() if line.startswith("'on'")]
    first = fresh_start(submission.sha256, VALUE)
    assert {name: BoardSetting(**of) for name, of in said.items()} == fresh_settings(settings, first)


@pytest.mark.parametrize("sees", ["privileged", "nothing"])
def test_a_reference_has_no_checkpoint_to_run_anew(submission, sees):
    about = replace(submission.declaration.about, observes=sees)
    reference = replace(submission, declaration=replace(submission.declaration, about=about))
    said = f"observes {sees}: a re-run evaluates the checkpoint of a policy that"
    with pytest.raises(InputError, match=said):
        instructions(reference, VALUE)
    with pytest.raises(InputError, match=said):
        compare_rerun(reference, rerun(reference, 1.0), VALUE)


@pytest.mark.parametrize("starts, enough", [(2, False), (5, False), (6, True)])
def test_starts_that_could_refuse_nothing_confirm_nothing(submission, starts, enough):
    """Two settings: from five starts each, all against none has p = 2 * 0.0079."""
    settings = {name: replace(one, episodes=starts) for name, one in submission.declaration.settings.items()}
    said = replace(submission.declaration, settings=settings)
    few = replace(submission, declaration=said, claims=claims(settings, 1.0))
    if enough:
        assert worse(few, rerun(few, 0.0)) == set(settings)
    else:
        with pytest.raises(InputError, match="Too few starts to confirm anything"):
            compare_rerun(few, rerun(few, 1.0), VALUE)


def test_a_task_with_one_initial_state_is_no_part_of_a_rerun(submission):
    """Its fresh starts are the start that is known."""
    settings = {"fixed": BoardSetting("brick_to_bin", 1), **submission.declaration.settings}
    declaration = replace(submission.declaration, settings=settings)
    more = replace(submission, declaration=declaration, claims=claims(settings, 1.0))
    assert "fixed" not in instructions(more, VALUE) and "fixed" not in compare_rerun(more, rerun(more, 1.0), VALUE)
    alone = replace(declaration, settings={"fixed": settings["fixed"]})
    with pytest.raises(InputError, match="one initial state each"):
        instructions(replace(submission, declaration=alone), VALUE)


def test_a_rerun_is_of_the_policy_that_was_submitted(submission):
    again = rerun(submission, 1.0)
    about = replace(again.declaration.about, revision="another commit")
    with pytest.raises(InputError, match="may be of another policy"):
        compare_rerun(submission, replace(again, declaration=replace(again.declaration, about=about)), VALUE)


@pytest.mark.parametrize(
    ("value", "said"), [("abc", "must be a round of drand"), (f"999999999:{'ab' * 32}", "is still to come")]
)
def test_what_is_no_public_value_is_refused(value, said):
    with pytest.raises(InputError, match=said):
        PublicValue.of(value)


def test_a_value_is_of_a_later_day_than_the_first_verdict():
    value = PublicValue.of(f" 20000000:{'AB' * 32}")
    assert str(value) == f"20000000:{'ab' * 32}" and value.published.date().isoformat() == "2025-07-18"
    check_later(value, "2025-07-17")
    for known in ("2025-07-18", "2026-01-01", None):
        with pytest.raises(InputError, match="a value of a later day"):
            check_later(value, known)


@pytest.mark.slow
def test_many_settings_hide_nothing(submission):
    settings = {f"setting_{number}": BoardSetting("block_to_bin", STARTS) for number in range(MOST_SETTINGS)}
    said = replace(submission.declaration, settings=settings)
    own = replace(submission, declaration=said, claims=claims(settings, 1.0))
    assert worse(own, rerun(own, 0.0)) == set(settings)


def test_better_on_fresh_starts_is_confirmed(submission):
    weak = replace(submission, claims=claims(submission.declaration.settings, 0.5))
    compare_rerun(weak, rerun(submission, 1.0), VALUE)


@pytest.mark.slow
def test_an_honest_submission_is_hardly_ever_refused(submission):
    refused = 0
    for seed in range(50):
        own = replace(submission, claims=claims(submission.declaration.settings, 0.8, seed))
        refused += bool(worse(own, rerun(submission, 0.8, 100 + seed)))
    assert refused <= 2
