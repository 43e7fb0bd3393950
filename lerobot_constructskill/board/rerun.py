"""The level re-run: the checkpoints are evaluated again, on starts that nobody could know before."""

from collections.abc import Mapping
from dataclasses import asdict
from datetime import date

import numpy as np
import yaml

from lerobot_constructskill.analysis.stats.comparisons import holm, mean_p_value
from lerobot_constructskill.analysis.stats.judgement import smallest_p_value
from lerobot_constructskill.board.protocol import RERUN_ALPHA, BoardSetting, PublicValue, fresh_settings, fresh_start
from lerobot_constructskill.board.submission import Submission
from lerobot_constructskill.contract import ANY_ACTION, OBS_TYPES
from lerobot_constructskill.errors import InputError

type Pairs = Mapping[str, tuple[np.ndarray, np.ndarray]]


def instructions(submission: Submission, value: PublicValue) -> str:
    """From which starts to run a submission's checkpoints again, and how.

    Raises:
        InputError: it is a reference, which has no checkpoint, or its tasks have one initial state each.
    """
    declaration = submission.declaration
    first = fresh_start(submission.sha256, value)
    settings = _fresh(submission, first)
    acting = f" --env.action={ANY_ACTION}" if ANY_ACTION in {claim.action for claim in submission.claims} else ""
    flags = [" ".join(f"--env.{name}='{one}'" for name, one in own.environment.items()) for own in settings.values()]
    commands = [
        "CONSTRUCTSKILL_RECORD=rerun/seed_N lerobot-eval --policy.path=CHECKPOINT --env.type=constructskill "
        f"{env}{acting} --env.obs_type={declaration.about.observes} --eval.n_episodes={setting.episodes} "
        f"--eval.batch_size=1 --seed={first}"
        for env, setting in zip(flags, settings.values(), strict=True)
    ]
    plain = {name: asdict(setting) for name, setting in settings.items()}
    return "\n".join(
        [
            f"The fresh starts are {first} and those that follow. For the checkpoint of each training seed N (with "
            "the --rename_map of its training, if any):",
            *commands,
            "Then make a submission of it with these settings, and verify it with --value and --rerun:",
            yaml.safe_dump(plain, default_flow_style=None, sort_keys=False, width=300).strip(),
        ]
    )


def check_later(value: PublicValue, known: str | None) -> None:
    """Refuse a value that was public when a submission was known.

    Args:
        known: day, in UTC, on which the submission was first verified; None if it was not.

    Raises:
        InputError: the value is not of a later day.
    """
    if known is None:
        raise InputError(
            "A re-run needs a value of a later day than the first verdict: record a replay first, with --record alone."
        )
    day = value.published.date()
    if day <= date.fromisoformat(known):
        raise InputError(
            f"The submission was first verified on {known} and the value was published on {day}: a re-run needs a "
            "value of a later day."
        )


def compare_rerun(submission: Submission, again: Submission, value: PublicValue) -> dict[str, tuple[float, float]]:
    """Compare a re-run with its submission.

    A permutation test, two-tailed and corrected by Holm over the settings, decides whether fresh starts went worse.
    Its unit is the start: the checkpoints are the same in both, so starts of one kind could be dealt to the two at
    random.

    Returns:
        For each setting the share of episodes that placed, as submitted and run again.

    Raises:
        InputError: fresh starts went worse than chance explains, or are too few to show that; it is a reference, or
            the re-run is not from the starts, not of the training seeds or not of the policy that it should be.
    """
    first = fresh_start(submission.sha256, value)
    if again.declaration.settings != _fresh(submission, first):
        raise InputError(f"The value {value} calls for the starts from {first} on; the re-run has others.")
    if again.declaration.about != submission.declaration.about:
        raise InputError("The re-run's about is not the submission's: it may be of another policy.")
    if set(again.declaration.training_seeds) != set(submission.declaration.training_seeds):
        raise InputError("The re-run does not have the submission's training seeds.")
    names = sorted(again.declaration.settings)
    return confirm({name: (_placed(submission, name), _placed(again, name)) for name in names}, "starts", "run anew")


def confirm(pairs: Pairs, units: str, how: str) -> dict[str, tuple[float, float]]:
    """Refuse what went worse the second time than chance explains.

    Args:
        pairs: for each setting the share of episodes that placed of every unit, (units,), as submitted and again.
        units: what the units are called.
        how: what was done again.

    Returns:
        For each setting the mean of the two.

    Raises:
        InputError: it went worse, or the units are too few to show that.
    """
    could_be = holm([smallest_p_value(len(own), len(fresh)) for own, fresh in pairs.values()])
    if min(could_be) >= RERUN_ALPHA:
        raise InputError(
            f"Too few {units} to confirm anything: if all placed as submitted and none {how}, p would be "
            f"{min(could_be):.2g}, not below {RERUN_ALPHA}."
        )
    rates = {name: (float(own.mean()), float(fresh.mean())) for name, (own, fresh) in pairs.items()}
    p_values = dict(zip(pairs, holm([mean_p_value(*pair) for pair in pairs.values()]), strict=True))
    worse = {name: own for name, own in rates.items() if own[1] < own[0] and p_values[name] < RERUN_ALPHA}
    if worse:
        told = "; ".join(f"{describe({name: own}, how)} (p = {p_values[name]:.2g})" for name, own in worse.items())
        raise InputError(f"The second time does not confirm it: {told}.")
    return rates


def describe(rates: dict[str, tuple[float, float]], how: str = "run anew") -> str:
    """The rates of `confirm` as text."""
    return "; ".join(f"{name} {own:.0%} submitted, {again:.0%} {how}" for name, (own, again) in rates.items())


def _fresh(submission: Submission, first: int) -> dict[str, BoardSetting]:
    """The settings of a submission's re-run. Raises InputError: it can have none."""
    about = submission.declaration.about
    if not about.is_policy:
        raise InputError(
            f"{about.name} observes {about.observes}: a re-run evaluates the checkpoint of a policy that observes "
            f"{' or '.join(OBS_TYPES)}."
        )
    if not (settings := fresh_settings(submission.declaration.settings, first)):
        raise InputError("Its tasks have one initial state each: a re-run would be from the starts that are known.")
    return settings


def _placed(submission: Submission, setting: str) -> np.ndarray:
    """Share of the training seeds that placed, from each start of a setting, (starts,); errors count as failed."""
    claims = sorted((one for one in submission.claims if one.setting == setting), key=lambda one: one.key)
    placed = np.array([claim.placed for claim in claims], dtype=float)  # by training seed, then by start
    return placed.reshape(len(submission.declaration.training_seeds), -1).mean(axis=0)
