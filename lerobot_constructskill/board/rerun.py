"""The highest level: the checkpoint evaluated anew, on starts that nobody could know when it was submitted."""

from dataclasses import dataclass
from itertools import groupby
from typing import Any

from lerobot_constructskill.board.protocol import fresh_settings, fresh_start
from lerobot_constructskill.board.submission import Submission
from lerobot_constructskill.errors import InputError


@dataclass(frozen=True)
class Rates:
    """Share of episodes that placed in one setting: as submitted, and run anew."""

    setting: str
    submitted: float
    again: float


@dataclass(frozen=True)
class Comparison:
    """A submission beside its re-run.

    Args:
        value: the public random number.
        rates: a row for every setting.
    """

    value: str
    rates: list[Rates]

    @property
    def sentence(self) -> str:
        each = [f"{one.setting} {one.submitted:.0%} submitted, {one.again:.0%} run anew" for one in self.rates]
        return f"Placed, on its own starts and on fresh ones: {'; '.join(each)}."

    @property
    def facts(self) -> dict[str, Any]:
        return {"value": self.value, "settings": {one.setting: [one.submitted, one.again] for one in self.rates}}


def instructions(submission: Submission, value: str) -> str:
    """From which starts to run a submission's checkpoint anew, and how."""
    declaration = submission.declaration
    first = fresh_start(submission.sha256, value)
    settings = fresh_settings(declaration.settings, first)
    lines = [f"The fresh starts are {first} and those that follow. For the checkpoint of each training seed N:"]
    for setting in settings.values():
        perturb = f" --env.perturb={setting.perturb} --env.perturb_seed={setting.perturb_seed}" * bool(setting.perturb)
        lines.append(
            "CONSTRUCTSKILL_RECORD=recorded/seed_N lerobot-eval --policy.path=CHECKPOINT --env.type=constructskill "
            f"--env.task={setting.task} --env.obs_type={declaration.about.observes} "
            f"--env.episode_length={setting.episode_length}{perturb} --eval.n_episodes={setting.episodes} "
            f"--eval.batch_size=1 --seed={first}"
        )
    lines.append("Then make a submission of it with these settings, and verify it with --value and --rerun:")
    for name, one in settings.items():
        perturbed = f", perturb: '{one.perturb}', perturb_seed: {one.perturb_seed}" * bool(one.perturb)
        lines.append(
            f"{name}: {{task: {one.task}, episodes: {one.episodes}, "
            f"episode_length: {one.episode_length}, first_start: {first}{perturbed}}}"
        )
    return "\n".join(lines)


def compare(submission: Submission, again: Submission, value: str) -> Comparison:
    """Set a re-run beside its submission.

    Raises:
        InputError: it is not from the starts, or not of the training seeds, that it should be.
    """
    first = fresh_start(submission.sha256, value)
    if again.declaration.settings != fresh_settings(submission.declaration.settings, first):
        raise InputError(f"{value!a:.80} calls for the starts from {first} on; the re-run has others.")
    if again.declaration.training_seeds != submission.declaration.training_seeds:
        raise InputError("The re-run does not have the submission's training seeds.")
    before, after = placed(submission), placed(again)
    return Comparison(value, [Rates(name, before[name], after[name]) for name in before])


def placed(submission: Submission) -> dict[str, float]:
    """Share of each setting's episodes that placed, over all training seeds; errors count as failed."""
    claims = sorted(submission.claims, key=lambda claim: claim.setting)
    groups = {name: list(of) for name, of in groupby(claims, key=lambda claim: claim.setting)}
    return {name: sum(one.placed for one in of) / len(of) for name, of in groups.items()}
