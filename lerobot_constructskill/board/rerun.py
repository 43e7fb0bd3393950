"""The highest level: the checkpoint evaluated anew, on starts that nobody could know when it was submitted."""

from collections import defaultdict
from dataclasses import dataclass
from typing import Any

import numpy as np

from lerobot_constructskill.analysis.stats.comparisons import holm
from lerobot_constructskill.analysis.stats.spread import mean_p_value
from lerobot_constructskill.board.protocol import RERUN_ALPHA, Setting, fresh_settings, fresh_start
from lerobot_constructskill.board.submission import Submission
from lerobot_constructskill.contract import OBS_TYPES
from lerobot_constructskill.errors import InputError


@dataclass(frozen=True)
class Rates:
    """Share of episodes that placed in one setting: as submitted, and run anew.

    Args:
        p_value: of a permutation test, two-tailed and corrected by Holm over the settings. Its unit is the start: the
            checkpoints are the same in both, so starts of one kind could be dealt to the two at random. Where there is
            one start alone, it is the training seed.
    """

    setting: str
    submitted: float
    again: float
    p_value: float

    @property
    def is_worse(self) -> bool:
        """Whether fresh starts went worse than chance explains."""
        return self.again < self.submitted and self.p_value < RERUN_ALPHA

    @property
    def sentence(self) -> str:
        return f"{self.setting} {self.submitted:.0%} submitted, {self.again:.0%} run anew"


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
        return f"Placed, on its own starts and on fresh ones: {'; '.join(one.sentence for one in self.rates)}."

    @property
    def facts(self) -> dict[str, Any]:
        return {"value": self.value, "settings": {one.setting: [one.submitted, one.again] for one in self.rates}}

    def confirm(self) -> None:
        """Raise InputError where fresh starts went worse than chance explains."""
        if worse := [f"{one.sentence} (p = {one.p_value:.2g})" for one in self.rates if one.is_worse]:
            raise InputError(f"The re-run does not confirm it: {'; '.join(worse)}.")


def instructions(submission: Submission, value: str) -> str:
    """From which starts to run a submission's checkpoint anew, and how.

    Raises:
        InputError: it is no policy that looks, so that there is no checkpoint to run.
    """
    _check_looks(submission)
    declaration = submission.declaration
    first = fresh_start(submission.sha256, value)
    settings = fresh_settings(declaration.settings, first)
    lines = [f"The fresh starts are {first} and those that follow. For the checkpoint of each training seed N:"]
    for setting in settings.values():
        perturb = f" --env.perturb='{setting.perturb}' --env.perturb_seed={setting.perturb_seed}" * _is_drawn(setting)
        lines.append(
            "CONSTRUCTSKILL_RECORD=rerun/seed_N lerobot-eval --policy.path=CHECKPOINT --env.type=constructskill "
            f"--env.task={setting.task} --env.obs_type={declaration.about.observes} "
            f"--env.episode_length={setting.episode_length}{perturb} --eval.n_episodes={setting.episodes} "
            f"--eval.batch_size=1 --seed={first}"
        )
    lines.append("Then make a submission of it with these settings, and verify it with --value and --rerun:")
    for name, one in settings.items():
        perturbed = f", perturb: '{one.perturb}', perturb_seed: {one.perturb_seed}" * _is_drawn(one)
        lines.append(
            f"'{name}': {{task: {one.task}, episodes: {one.episodes}, "
            f"episode_length: {one.episode_length}, first_start: {first}{perturbed}}}"
        )
    return "\n".join(lines)


def _check_looks(submission: Submission) -> None:
    about = submission.declaration.about
    if about.observes not in OBS_TYPES:
        raise InputError(
            f"{about.name} observes {about.observes}: a re-run evaluates the checkpoint of a policy that observes "
            f"{' or '.join(OBS_TYPES)}."
        )


def _is_drawn(setting: Setting) -> bool:
    """Whether it names a perturbation or a draw, which a re-run's settings have to repeat."""
    return bool(setting.perturb or setting.perturb_seed)


def compare(submission: Submission, again: Submission, value: str) -> Comparison:
    """Set a re-run beside its submission.

    Raises:
        InputError: it is no policy that looks, the re-run is not from the starts or not of the training seeds that it
            should be, or they are too few for the test to refuse anything.
    """
    _check_looks(submission)
    first = fresh_start(submission.sha256, value)
    if again.declaration.settings != fresh_settings(submission.declaration.settings, first):
        raise InputError(f"{value!a:.80} calls for the starts from {first} on; the re-run has others.")
    if set(again.declaration.training_seeds) != set(submission.declaration.training_seeds):
        raise InputError("The re-run does not have the submission's training seeds.")
    names = sorted(submission.declaration.settings)
    pairs = [(placed(submission, name), placed(again, name)) for name in names]
    could_be = holm([mean_p_value(np.ones(len(own)), np.zeros(len(fresh))) for own, fresh in pairs])
    if min(could_be) >= RERUN_ALPHA:
        raise InputError(
            "Too few starts to confirm anything: if all placed as submitted and none anew, p would be "
            f"{min(could_be):.2g}, not below {RERUN_ALPHA}."
        )
    p_values = holm([mean_p_value(*pair) for pair in pairs])
    rows = zip(names, pairs, p_values, strict=True)
    return Comparison(value, [Rates(name, own.mean(), fresh.mean(), p) for name, (own, fresh), p in rows])


def placed(submission: Submission, setting: str) -> np.ndarray:
    """Share of the training seeds that placed, from each start of a setting, (starts,); errors count as failed.

    Of a setting with one start: which training seeds placed, (training seeds,).
    """
    unit = "training_seed" if submission.declaration.settings[setting].episodes == 1 else "evaluation_seed"
    by_unit = defaultdict(list)
    for claim in submission.claims:
        if claim.setting == setting:
            by_unit[getattr(claim, unit)].append(claim.placed)
    return np.array([np.mean(of) for of in by_unit.values()])
