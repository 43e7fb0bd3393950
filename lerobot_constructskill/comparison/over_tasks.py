"""Compares two variants over several tasks: in each, and by the mean over tasks of every training seed."""

from dataclasses import dataclass, replace

import numpy as np

from lerobot_constructskill.analysis.stats.judgement import Judgement, judge
from lerobot_constructskill.comparison.match import Asked, Evaluate, MatchedSides, match
from lerobot_constructskill.comparison.sides import IN_STUDY, Source, settings_of
from lerobot_constructskill.errors import InputError

EVERY = "*/"
"""Before the name of a variant: every setting of the study that it ran in."""


@dataclass(frozen=True)
class OverTasks:
    """Two sides in several tasks.

    Args:
        tasks: setting to the sides there; each has the same training seeds in all of them.
        rates_a, rates_b: share of the episodes that placed, the mean over tasks, of each training seed.
        judgement: the statistics of these means.
    """

    tasks: dict[str, MatchedSides]
    rates_a: list[float]
    rates_b: list[float]
    judgement: Judgement


def is_over_tasks(a: Source, b: Source) -> bool:
    """Whether both sides are named in every setting.

    Raises:
        InputError: one side alone is, or is of no study.
    """
    every = [one.kind == IN_STUDY and one.arm.startswith(EVERY) for one in (a, b)]
    if any(every) and not all(every):
        one = (a, b)[every.index(True)]
        raise InputError(f"'{one.name}' is of several tasks: name the other side as STUDY:*/VARIANT too.")
    return all(every)


def match_over_tasks(a: Source, b: Source, asked: Asked, evaluate: Evaluate, alpha: float) -> OverTasks:
    """Judge a against b in every setting that both ran in, and over all of them.

    Raises:
        MissingError: a side is not there.
        InputError: a side cannot be read, there is no such setting, or a side has other training seeds in one of them.
    """
    names = [name for name in settings_of(a) if name in settings_of(b)]
    if not names:
        raise InputError(f"'{a.name}' and '{b.name}' ran in no setting together.")
    tasks = {name: match(_in(name, a), _in(name, b), asked, evaluate, alpha) for name in names}
    rates_a, rates_b = (np.mean(rates, axis=0) for rates in (_rates(tasks, "a"), _rates(tasks, "b")))
    one = next(iter(tasks.values()))
    return OverTasks(tasks, [*rates_a], [*rates_b], judge(one.a.units(rates_a), one.b.units(rates_b), alpha))


def _in(setting: str, source: Source) -> Source:
    """The source in one setting."""
    arm = setting + source.arm.removeprefix(EVERY[:-1])
    return replace(source, arm=arm, name=f"{source.folders[0]}:{arm}")


def _rates(tasks: dict[str, MatchedSides], letter: str) -> list[list[float]]:
    """The rates of a side's training seeds in each task."""
    first, *others = (getattr(matched, letter) for matched in tasks.values())
    for side in others:
        if side.numbers != first.numbers:
            raise InputError(
                f"'{side.name}' and '{first.name}' have other training seeds: a mean is of the same ones."
            )
    return [getattr(matched, f"rates_{letter}") for matched in tasks.values()]
