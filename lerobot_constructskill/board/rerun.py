"""The level re-run: the checkpoints are evaluated again, on starts that nobody could know before."""

from dataclasses import asdict

import numpy as np
import yaml

from lerobot_constructskill.analysis.stats.comparisons import holm, mean_p_value
from lerobot_constructskill.board.protocol import RERUN_ALPHA, fresh_settings, fresh_start
from lerobot_constructskill.board.submission import Submission
from lerobot_constructskill.contract import ANY_ACTION, OBS_TYPES
from lerobot_constructskill.errors import InputError


def instructions(submission: Submission, value: str) -> str:
    """From which starts to run a submission's checkpoints again, and how.

    Args:
        value: the public random number, as of `protocol.fresh_start`.

    Raises:
        InputError: it is a reference, which has no checkpoint.
    """
    _check_policy(submission)
    declaration = submission.declaration
    first = fresh_start(submission.sha256, value)
    settings = fresh_settings(declaration.settings, first)
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
            f"The fresh starts are {first} and those that follow. For the checkpoint of each training seed N:",
            *commands,
            "Then make a submission of it with these settings, and verify it with --value and --rerun:",
            yaml.safe_dump(plain, default_flow_style=None, sort_keys=False, width=300).strip(),
        ]
    )


def compare_rerun(submission: Submission, again: Submission, value: str) -> dict[str, tuple[float, float]]:
    """Compare a re-run with its submission.

    A permutation test, two-tailed and corrected by Holm over the settings, decides whether fresh starts went worse.
    Its unit is the start: the checkpoints are the same in both, so starts of one kind could be dealt to the two at
    random. Where there is one start alone, the unit is the training seed.

    Args:
        value: the public random number, as of `protocol.fresh_start`.

    Returns:
        For each setting the share of episodes that placed, as submitted and run again.

    Raises:
        InputError: fresh starts went worse than chance explains, or are too few to show that; it is a reference, or
            the re-run is not from the starts or not of the training seeds that it should be.
    """
    _check_policy(submission)
    first = fresh_start(submission.sha256, value)
    if again.declaration.settings != fresh_settings(submission.declaration.settings, first):
        raise InputError(f"{value!a:.80} calls for the starts from {first} on; the re-run has others.")
    if set(again.declaration.training_seeds) != set(submission.declaration.training_seeds):
        raise InputError("The re-run does not have the submission's training seeds.")
    names = sorted(submission.declaration.settings)
    pairs = [(_placed(submission, name), _placed(again, name)) for name in names]
    could_be = holm([mean_p_value(np.ones_like(own), np.zeros_like(fresh)) for own, fresh in pairs])
    if min(could_be) >= RERUN_ALPHA:
        raise InputError(
            "Too few starts to confirm anything: if all placed as submitted and none anew, p would be "
            f"{min(could_be):.2g}, not below {RERUN_ALPHA}."
        )
    rates = {name: (own.mean(), fresh.mean()) for name, (own, fresh) in zip(names, pairs, strict=True)}
    p_values = dict(zip(names, holm([mean_p_value(*pair) for pair in pairs]), strict=True))
    worse = {name: own for name, own in rates.items() if own[1] < own[0] and p_values[name] < RERUN_ALPHA}
    if worse:
        told = "; ".join(f"{describe({name: own})} (p = {p_values[name]:.2g})" for name, own in worse.items())
        raise InputError(f"The re-run does not confirm it: {told}.")
    return rates


def describe(rates: dict[str, tuple[float, float]]) -> str:
    """The rates of `compare_rerun` as text."""
    return "; ".join(f"{name} {own:.0%} submitted, {again:.0%} run anew" for name, (own, again) in rates.items())


def _check_policy(submission: Submission) -> None:
    about = submission.declaration.about
    if not about.is_policy:
        raise InputError(
            f"{about.name} observes {about.observes}: a re-run evaluates the checkpoint of a policy that observes "
            f"{' or '.join(OBS_TYPES)}."
        )


def _placed(submission: Submission, setting: str) -> np.ndarray:
    """Share of the training seeds that placed, from each start of a setting, (starts,); errors count as failed.

    Of a setting with one start: which training seeds placed, (training seeds,).
    """
    claims = sorted((one for one in submission.claims if one.setting == setting), key=lambda one: one.key)
    placed = np.array([claim.placed for claim in claims], dtype=float)  # by training seed, then by start
    placed = placed.reshape(len(submission.declaration.training_seeds), -1)
    return placed[:, 0] if placed.shape[1] == 1 else placed.mean(axis=0)
