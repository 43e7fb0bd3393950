"""Two sides brought together: in the same conditions and from the same starts, whatever versions made them."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from lerobot_constructskill.analysis.stats.judgement import Judgement, judge
from lerobot_constructskill.comparison.find import CHECKPOINT, EVALUATED, STUDY_KIND, Found
from lerobot_constructskill.comparison.read import read_evaluated, read_recorded, read_study
from lerobot_constructskill.comparison.sides import Conditions, Side
from lerobot_constructskill.errors import InputError
from lerobot_constructskill.perturbations import Perturbation

FIRST_START, EPISODES = 1000, 50
"""Defaults of `lerobot-eval`."""

Evaluate = Callable[[Found, Mapping[str, Any], Sequence[int]], Side]
"""Called with checkpoints, an environment's keyword arguments and starts."""


@dataclass(frozen=True)
class Asked:
    """What a user says of the evaluation, where no side does; the defaults are those of `lerobot-eval`.

    Args:
        env: keyword arguments of `ConstructSkillEnv`, those alone that were given.
        seed: seed of the first episode.
        episodes: episodes; of a side that has more the first are taken.
    """

    env: Mapping[str, Any] = field(default_factory=dict)
    seed: int | None = None
    episodes: int | None = None


@dataclass(frozen=True)
class Comparison:
    """Two sides and what their seeds say.

    Args:
        a, b: the sides.
        conditions: where both were evaluated.
        starts: seeds of the episodes that both have, in order.
        n_starts: number of different starts that the sides have together.
        rates_a, rates_b: share of those episodes that placed, of each training seed; 0 for one that failed.
        judgement: the statistics.
    """

    a: Side
    b: Side
    conditions: Conditions
    starts: list[int]
    n_starts: int
    rates_a: list[float]
    rates_b: list[float]
    judgement: Judgement


def compare(a: Found, b: Found, asked: Asked, evaluate: Evaluate, alpha: float) -> Comparison:
    """Bring two sides together and judge a over b.

    Raises:
        MissingError, InputError: a side cannot be read, or nothing of it can be compared with the other.
    """
    _check_asked(a, b, asked)
    sides = {one: _read(one) for one in (a, b) if one.kind not in (CHECKPOINT, EVALUATED)}
    env = _env_of([*sides.values()], asked)
    conditions = Conditions.of(env)
    label = Perturbation(conditions.perturb, conditions.perturb_seed).label
    for one in (a, b):
        if one.kind == EVALUATED:
            sides[one] = read_evaluated(one.name, one.folders, asked.seed, conditions.task, label)
    starts = _starts_of([*sides.values()], asked)
    for one in (a, b):
        if one.kind == CHECKPOINT:
            sides[one] = evaluate(one, env, starts)
    return judged(sides[a], sides[b], conditions, starts, alpha)


def judged(a: Side, b: Side, conditions: Conditions, starts: Sequence[int], alpha: float) -> Comparison:
    """The comparison of two sides on starts that both have."""
    rates = [[_rate(outcomes, starts) for outcomes in side.seeds] for side in (a, b)]
    either = set.union(*(side.starts or set() for side in (a, b)))
    judgement = judge(*map(np.array, rates), alpha)
    return Comparison(a, b, conditions, list(starts), len(either), *rates, judgement)


def _check_asked(a: Found, b: Found, asked: Asked) -> None:
    if a.arm == b.arm and (both := {*map(Path.resolve, a.folders)} & {*map(Path.resolve, b.folders)}):
        raise InputError(f"'{min(both)}' is on both sides; name another for one of them.")
    kinds = {a.kind, b.kind}
    if asked.seed is not None and EVALUATED not in kinds and kinds != {CHECKPOINT}:
        raise InputError("The starts of these sides are known: leave out --seed.")


def _read(found: Found) -> Side:
    if found.kind == STUDY_KIND:
        return read_study(found.folders[0], found.arm)
    return read_recorded(found.name, found.folders)


def _env_of(known: Sequence[Side], asked: Asked) -> Mapping[str, Any]:
    """The environment that sides were evaluated in, or that was asked for.

    Raises:
        InputError: they differ, or nothing says which task.
    """
    if not known:
        if "task" not in asked.env:
            raise InputError("Neither side says in which task it was, or is to be, evaluated: add --task.")
        return asked.env
    first, *others = known
    for other in others:
        _refuse(f"'{first.name}' and '{other.name}'", first.conditions, other.conditions)
    _refuse(f"'{first.name}' and what was asked for", first.conditions, Conditions.of({**first.env, **asked.env}))
    return first.env


def _refuse(who: str, one: Conditions, other: Conditions) -> None:
    if different := one.differences(other):
        raise InputError(f"{who} cannot be compared: they differ in {', '.join(different)}.")


def _starts_of(known: Sequence[Side], asked: Asked) -> list[int]:
    """The starts that every side has, the first of them if so many were asked for.

    Raises:
        InputError: there are none.
    """
    if not known:
        first = FIRST_START if asked.seed is None else asked.seed
        return list(range(first, first + (asked.episodes or EPISODES)))
    for side in known:
        if side.starts is None:
            raise InputError(f"Every training seed of '{side.name}' failed, so there is nothing to compare.")
        if not side.starts:
            raise InputError(f"The training seeds of '{side.name}' have no start in common.")
    common = sorted(set.intersection(*(side.starts for side in known)))
    if not common:
        told = " and ".join(f"'{side.name}' has {tell_starts(sorted(side.starts))}" for side in known)
        raise InputError(f"The sides have no start in common: {told}; evaluate one from the other's starts.")
    return common[: asked.episodes]


def tell_starts(starts: Sequence[int]) -> str:
    """Such as "starts 1000 to 1049"."""
    if len(starts) == 1:
        return f"start {starts[0]}"
    between = "to" if starts[-1] - starts[0] == len(starts) - 1 else "and others up to"
    return f"starts {starts[0]} {between} {starts[-1]}"


def _rate(outcomes: Mapping[int, bool] | None, starts: Sequence[int]) -> float:
    return float(np.mean([outcomes[start] for start in starts])) if outcomes else 0.0
