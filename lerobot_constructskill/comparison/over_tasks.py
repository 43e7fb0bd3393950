"""Compares two sides over several tasks: in each, and by the mean over tasks of every training seed."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from lerobot_constructskill.analysis.stats.judgement import Judgement, judge
from lerobot_constructskill.comparison.match import Asked, Evaluate, MatchedSides, chance, finish, match, prepare
from lerobot_constructskill.comparison.sides import (
    CHECKPOINT,
    IN_STUDY,
    RECORDED,
    Place,
    Side,
    Source,
    is_of_several,
    place_of,
    read_recorded,
    settings_of,
)
from lerobot_constructskill.contract import ANY_ACTION, select_tasks
from lerobot_constructskill.errors import InputError
from lerobot_constructskill.perturbations import Perturbation


@dataclass(frozen=True)
class OverTasks:
    """Two sides in several tasks.

    Args:
        names: what the user called the sides.
        tasks: setting of a study, or else task, to the sides there; each has the same training seeds in all of them.
        only_a, only_b: settings or tasks that the other side does not have or name.
        perturbed: perturbed tasks of both, which are left out of a mean with others.
        rates_a, rates_b: share of the episodes that placed, the mean over tasks, of each training seed.
        chance_a, chance_b: as in `MatchedSides`, of these means.
        judgement: the statistics of these means.
    """

    names: tuple[str, str]
    tasks: dict[str, MatchedSides]
    only_a: list[str]
    only_b: list[str]
    perturbed: list[str]
    rates_a: list[float]
    rates_b: list[float]
    chance_a: float | None
    chance_b: float | None
    judgement: Judgement


def match_over_tasks(a: Source, b: Source, asked: Asked, evaluate: Evaluate, alpha: float) -> OverTasks | MatchedSides:
    """Judge a against b in every task of both, and over all of them; as `match` does if neither is of several tasks.

    Checkpoints are of every task of the other side, or of those that were asked for.

    Raises:
        MissingError: a side is not there.
        InputError: a side cannot be read, the sides have no task in common, one is of several tasks and the other of
            one, or a side has other training seeds in one of them.
    """
    wanted = _wanted(asked)
    a, b = (replace(one, recorded=read_recorded(one)) if one.kind == RECORDED else one for one in (a, b))
    of_a, of_b = (_places(one, wanted, asked) for one in (a, b))
    is_several = {one: is_of_several(one) for one in (a, b)}
    if not any(is_several.values()) and all(len(places or ()) < 2 for places in (of_a, of_b)):
        a, b = (
            _in(*next(iter(places.items())), one) if one.kind == RECORDED and places else one
            for one, places in ((a, of_a), (b, of_b))
        )
        return match(a, b, asked, evaluate, alpha)
    for one, other in ((a, b), (b, a)):
        if one.kind == IN_STUDY and not is_several[one]:
            several = f"--task={asked.env['task']}" if len(wanted) > 1 else f"'{other.name}'"
            raise InputError(f"{several} is of several tasks: name '{one.name}' as STUDY:*/VARIANT too.")
    shared, only_a, only_b = _shared(a, b, of_a, of_b)
    perturbed = sorted(name for name, place in shared.items() if place.perturbation)
    if IN_STUDY in (a.kind, b.kind) or len(perturbed) == len(shared):  # what a study means, or all there is
        perturbed = []
    shared = {name: place for name, place in shared.items() if name not in perturbed}
    prepared = {}
    for name, place in shared.items():
        there = replace(asked, env={**asked.env, "task": place.task}) if wanted else asked
        prepared[name] = prepare(_in(name, place, a), _in(name, place, b), there)
    for letter in "ab":
        _check_seeds([getattr(one, letter) for one in prepared.values()])
    tasks = {name: finish(one, evaluate, alpha) for name, one in prepared.items()}
    matched = list(tasks.values())
    rates_a, rates_b = (np.mean([getattr(one, f"rates_{letter}") for one in matched], axis=0) for letter in "ab")
    return OverTasks(
        (a.name, b.name),
        tasks,
        only_a,
        only_b,
        perturbed,
        [*rates_a],
        [*rates_b],
        chance([one.a for one in matched], [one.starts for one in matched]),
        chance([one.b for one in matched], [one.starts for one in matched]),
        judge(matched[0].a.units(rates_a), matched[0].b.units(rates_b), alpha),
    )


def _wanted(asked: Asked) -> list[str]:
    """The tasks that were asked for; none if all are meant."""
    if "task" not in asked.env:
        return []
    return [row.name for rows in select_tasks(asked.env["task"], ANY_ACTION).values() for row in rows]


def _places(source: Source, wanted: Sequence[str], asked: Asked) -> dict[str, Place] | None:
    """Where a side acts, by its study's setting or the place's own name; None for checkpoints that act anywhere."""
    if source.kind == CHECKPOINT:
        places = [place_of({**asked.env, "task": task}) for task in wanted]
        return {str(place): place for place in places} or None
    if source.kind == IN_STUDY:
        found = settings_of(source)
    else:
        of_all = {place_of(vars(one)) for episodes in read_recorded(source).values() for one in episodes}
        found = {str(place): place for place in sorted(of_all)}
        if "perturb" in asked.env:
            label = Perturbation(asked.env["perturb"], asked.env.get("perturb_seed", 0)).label
            found = {name: place for name, place in found.items() if place.perturbation == label}
    return {name: place for name, place in found.items() if place.task in (wanted or [place.task])}


def _shared(
    a: Source, b: Source, of_a: dict[str, Place] | None, of_b: dict[str, Place] | None
) -> tuple[dict[str, Place], list[str], list[str]]:
    """The settings or places of both sides, and those of one side alone. Raises InputError if both have none."""
    if of_a is None or of_b is None:
        shared, only_a, only_b = dict(of_a or of_b or {}), [], []
    elif a.kind == b.kind == IN_STUDY:
        shared = {name: place for name, place in of_a.items() if name in of_b}
        only_a, only_b = ([*one.keys() - other.keys()] for one, other in ((of_a, of_b), (of_b, of_a)))
    else:  # of a study's setting and a recording, the place is the same and the name need not be
        named = of_b if b.kind == IN_STUDY else of_a
        shared = {name: place for name, place in named.items() if place in {*of_a.values()} & {*of_b.values()}}
        only_a, only_b = (
            [name for name, place in one.items() if place not in other.values()]
            for one, other in ((of_a, of_b), (of_b, of_a))
        )
    if not shared:
        ran = " and ".join(
            f"'{one.name}' in {', '.join(own) or 'none'}" for one, own in ((a, of_a), (b, of_b)) if own is not None
        )
        raise InputError(f"The sides ran in no setting together: {ran}.")
    return shared, sorted(only_a), sorted(only_b)


def _in(name: str, place: Place, source: Source) -> Source:
    """The source in one setting or task."""
    if source.kind == CHECKPOINT:
        return source
    if source.kind == IN_STUDY:
        arm = f"{name}/{source.variant}"
        return replace(source, arm=arm, name=f"{source.folders[0]}:{arm}")
    own = {
        folder: [one for one in episodes if place_of(vars(one)) == place]
        for folder, episodes in read_recorded(source).items()
    }
    if bare := [folder for folder, episodes in own.items() if not episodes]:
        raise InputError(f"'{bare[0]}' has no recording of {place}: every training seed is recorded in all tasks.")
    return replace(source, recorded=own)


def _check_seeds(sides: Sequence[Side | None]) -> None:
    """Refuse a side whose training seeds differ between tasks."""
    known = [side for side in sides if side is not None]
    for side in known[1:]:
        if side.numbers != known[0].numbers or len(side.seeds) != len(known[0].seeds):
            raise InputError(
                f"'{side.name}' and '{known[0].name}' have other training seeds: a mean is of the same ones."
            )
