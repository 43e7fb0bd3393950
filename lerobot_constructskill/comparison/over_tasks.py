"""Compares two sides over several tasks: in each, and by the mean over tasks of every training seed."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from lerobot_constructskill.analysis.stats.judgement import Judgement, judge
from lerobot_constructskill.comparison.match import Asked, Evaluate, MatchedSides, match
from lerobot_constructskill.comparison.sides import (
    CHECKPOINT,
    EVERY,
    IN_STUDY,
    RECORDED,
    Source,
    read_recorded,
    settings_of,
)
from lerobot_constructskill.contract import ANY_ACTION, select_tasks
from lerobot_constructskill.errors import InputError
from lerobot_constructskill.study.rows import read_means


@dataclass(frozen=True)
class OverTasks:
    """Two sides in several tasks.

    Args:
        tasks: setting of a study, or else task, to the sides there; each has the same training seeds in all of them.
        left_out: side, "A" or "B", to the settings in which the other side alone ran.
        rates_a, rates_b: share of the episodes that placed, the mean over tasks, of each training seed.
        chance_a, chance_b: as in `MatchedSides`, of these means.
        judgement: the statistics of these means.
    """

    tasks: dict[str, MatchedSides]
    left_out: dict[str, list[str]]
    rates_a: list[float]
    rates_b: list[float]
    chance_a: float | None
    chance_b: float | None
    judgement: Judgement


def match_over_tasks(a: Source, b: Source, asked: Asked, evaluate: Evaluate, alpha: float) -> OverTasks | None:
    """Judge a against b in every task of both, and over all of them; None if neither side is of several tasks.

    Checkpoints are of every task: of those of the other side, or of those that were asked for.

    Raises:
        MissingError: a side is not there.
        InputError: a side cannot be read, the sides have no task in common, one is of several tasks and the other of
            one, or a side has other training seeds in one of them.
    """
    a, b = (replace(one, recorded=read_recorded(one)) if one.kind == RECORDED else one for one in (a, b))
    of_a, of_b = (_tasks(source, asked) for source in (a, b))
    if not any(tasks and len(tasks) > 1 for tasks in (of_a, of_b)) and not (_is_of_several(a) or _is_of_several(b)):
        return None
    names, left_out = _shared(a, b, of_a, of_b)
    tasks = {}
    for name, task in names.items():
        there = replace(asked, env={**asked.env, "task": task}) if "task" in asked.env else asked
        tasks[name] = match(_in(name, task, a), _in(name, task, b), there, evaluate, alpha)
    rates_a, rates_b = (np.mean(rates, axis=0) for rates in (_rates(tasks, "a"), _rates(tasks, "b")))
    one = next(iter(tasks.values()))
    return OverTasks(
        tasks,
        left_out,
        [*rates_a],
        [*rates_b],
        _chance([matched.chance_a for matched in tasks.values()]),
        _chance([matched.chance_b for matched in tasks.values()]),
        judge(one.a.units(rates_a), one.b.units(rates_b), alpha),
    )


def _tasks(source: Source, asked: Asked) -> dict[str, str] | None:
    """What a side was evaluated in: settings of a study, or else tasks, to their tasks; None for checkpoints."""
    if source.kind == IN_STUDY:
        return settings_of(source)
    if source.kind == RECORDED:
        names = dict.fromkeys(one.task for episodes in read_recorded(source).values() for one in episodes)
        return {name: name for name in names}
    if "task" not in asked.env:
        return None
    return {row.name: row.name for rows in select_tasks(asked.env["task"], ANY_ACTION).values() for row in rows}


def _shared(
    a: Source, b: Source, of_a: Mapping[str, str] | None, of_b: Mapping[str, str] | None
) -> tuple[dict[str, str], dict[str, list[str]]]:
    """The settings or tasks of both sides, and those of one side that the other has not.

    Raises:
        InputError: there are none, or one side names several and the other one.
    """
    if of_a is None or of_b is None:
        return dict(of_a or of_b or {}), {}
    for one, other in ((a, b), (b, a)):
        if one.kind == IN_STUDY and not _is_of_several(one):
            raise InputError(f"'{other.name}' is of several tasks: name the other side as STUDY:*/VARIANT too.")
    names = of_a if a.kind == IN_STUDY else of_b
    by_name = a.kind == b.kind == IN_STUDY
    first, second = ([*own] if by_name else [*own.values()] for own in (of_a, of_b))
    shared = {name: task for name, task in names.items() if {name if by_name else task} <= {*first} & {*second}}
    if not shared:
        ran = " and ".join(f"'{one.name}' in {', '.join(own) or 'none'}" for one, own in ((a, of_a), (b, of_b)))
        raise InputError(f"The sides ran in no setting together: {ran}.")
    left_out = {
        "A": [name for name in first if name not in second],
        "B": [name for name in second if name not in first],
    }
    return shared, {letter: left for letter, left in left_out.items() if left}


def _is_of_several(source: Source) -> bool:
    """Whether a side names several settings of a study, whatever number of them was run."""
    return source.kind == IN_STUDY and source.arm.partition("/")[0] in (EVERY, *read_means(source.folders[0]))


def _in(name: str, task: str, source: Source) -> Source:
    """The source in one setting or task."""
    if source.kind == RECORDED:
        own = {
            folder: [one for one in episodes if one.task == task] for folder, episodes in read_recorded(source).items()
        }
        return replace(source, recorded=own)
    if source.kind == CHECKPOINT:
        return source
    arm = f"{name}/{source.arm.rpartition('/')[2]}"
    return replace(source, arm=arm, name=f"{source.folders[0]}:{arm}")


def _chance(each: Sequence[float | None]) -> float | None:
    """Of means over tasks, from the value in each task."""
    known = [one for one in each if one is not None]
    return float(np.hypot.reduce(known)) / len(known) if len(known) == len(each) else None


def _rates(tasks: Mapping[str, MatchedSides], letter: str) -> list[list[float]]:
    """The rates of a side's training seeds in each task."""
    first, *others = (getattr(matched, letter) for matched in tasks.values())
    for side in others:
        if side.numbers != first.numbers or len(side.seeds) != len(first.seeds):
            raise InputError(
                f"'{side.name}' and '{first.name}' have other training seeds: a mean is of the same ones."
            )
    return [getattr(matched, f"rates_{letter}") for matched in tasks.values()]
