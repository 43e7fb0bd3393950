"""Compares two sides in the same conditions and from the same starts, whatever versions made them."""

from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from lerobot_constructskill.analysis.stats.judgement import Judgement, judge
from lerobot_constructskill.analysis.stats.outcomes import spread_by_chance
from lerobot_constructskill.comparison.sides import (
    CHECKPOINT,
    Side,
    Source,
    are_apart,
    check_equal,
    conditions,
    read,
)
from lerobot_constructskill.errors import InputError

FIRST_START, EPISODES = 1000, 50
"""Defaults of `lerobot-eval`."""

Evaluate = Callable[[Source, Mapping[str, Any], Sequence[int]], Side]
"""Called with a source of checkpoints, keyword arguments of `ConstructSkillEnv` and starts."""


@dataclass(frozen=True)
class Asked:
    """What a user says of the evaluation.

    Args:
        env: keyword arguments of `ConstructSkillEnv` that were given.
        seed: seed of the first episode.
        episodes: number of episodes; of a side with more, the first are taken.
    """

    env: Mapping[str, Any] = field(default_factory=dict)
    seed: int | None = None
    episodes: int | None = None


@dataclass(frozen=True)
class MatchedSides:
    """Two sides and what their seeds show.

    Args:
        a, b: the sides.
        conditions: conditions that both were evaluated in.
        starts: starts that both have, in order.
        episodes: how many of them each training seed was evaluated from: all, unless draws have starts of their own.
        n_starts: number of different starts that the sides have together.
        rates_a, rates_b: share of the episodes from `starts` that placed, of each training seed; 0 for a failed one.
        chance_a, chance_b: standard deviation over seeds that single episodes alone give, as `chance` says.
        judgement: the statistics.
    """

    a: Side
    b: Side
    conditions: dict[str, Any]
    starts: list[int]
    episodes: int
    n_starts: int
    rates_a: list[float]
    rates_b: list[float]
    chance_a: float | None
    chance_b: float | None
    judgement: Judgement


@dataclass(frozen=True)
class Prepared:
    """Two sides of which everything is checked that can be before anything is evaluated.

    Args:
        sources: of a and of b.
        a, b: the sides; None for checkpoints, which are to be evaluated.
        env: keyword arguments of the `ConstructSkillEnv` that both act in.
        starts: as in `MatchedSides`.
        apart: starts of each draw, where draws have starts of their own.
    """

    sources: tuple[Source, Source]
    a: Side | None
    b: Side | None
    env: Mapping[str, Any]
    starts: list[int]
    apart: list[set[int]] | None


def match(a: Source, b: Source, asked: Asked, evaluate: Evaluate, alpha: float) -> MatchedSides:
    """Read or evaluate two sides and judge a against b.

    Raises:
        MissingError: a side is not there.
        InputError: a side cannot be read, or nothing of it can be compared with the other.
    """
    return finish(prepare(a, b, asked), evaluate, alpha)


def prepare(a: Source, b: Source, asked: Asked) -> Prepared:
    """Read two sides and check that they can be compared. Raises as `match` does."""
    _check_sources(a, b, asked)
    of_a, of_b = (None if one.kind == CHECKPOINT else read(one) for one in (a, b))
    known = [side for side in (of_a, of_b) if side is not None]
    env, apart = _common_env(known, asked), _starts_apart(known)
    if apart and asked.episodes:
        raise InputError("Draws of these sides have starts of their own: leave out --episodes.")
    starts = sorted(set.union(*apart)) if apart else _common_starts(known, asked)
    return Prepared((a, b), of_a, of_b, env, starts, apart)


def finish(prepared: Prepared, evaluate: Evaluate, alpha: float) -> MatchedSides:
    """Evaluate checkpoints and judge a against b. Raises as `match` does."""
    env, starts, apart = prepared.env, prepared.starts, prepared.apart
    a, b = (
        side or evaluate(source, env, starts)
        for source, side in zip(prepared.sources, (prepared.a, prepared.b), strict=True)
    )
    either = set.union(*apart) if apart else set.union(*(side.starts or set() for side in (a, b)))
    rates_a, rates_b = (
        [
            float(np.mean([placed[start] for start in starts if start in placed])) if placed else 0.0
            for placed in side.seeds
        ]
        for side in (a, b)
    )
    return MatchedSides(
        a,
        b,
        conditions(env),
        starts,
        max(map(len, apart)) if apart else len(starts),
        len(either),
        rates_a,
        rates_b,
        chance([a], [starts]),
        chance([b], [starts]),
        judge(a.units(rates_a), b.units(rates_b), alpha),
    )


def chance(sides: Sequence[Side], starts: Sequence[Sequence[int]]) -> float | None:
    """`spread_by_chance` of one side's share, or of its mean over tasks.

    Args:
        sides: the side in each task.
        starts: those of each task.

    Returns:
        None too where a seed failed, or seeds share a draw.
    """
    if any(None in side.seeds or side.unit != "seed" for side in sides):
        return None
    return spread_by_chance(
        [
            [{start: placed[start] for start in own if start in placed} for placed in side.seeds if placed is not None]
            for side, own in zip(sides, starts, strict=True)
        ]
    )


def _starts_apart(known: Sequence[Side]) -> list[set[int]] | None:
    """Starts of each draw, where both sides are known and their draws have the same starts of their own.

    How many seeds a draw has does not matter. A seed that failed may be the only one of its draw.

    Raises:
        InputError: of one side draws have starts of their own, and the other side has not the same.
    """
    own = next((side for side in known if are_apart(side.starts_of_each)), None)
    if own is None:
        return None
    lists = [{frozenset(starts) for starts in side.starts_of_each if starts} for side in known]
    every = [*map(set, set.union(*lists))]
    is_whole = [len(every) == len(own) + side.failed_draws for own, side in zip(lists, known, strict=True)]
    if len(known) == 2 and are_apart(every) and all(is_whole):
        return every
    raise InputError(
        f"Each draw of '{own.name}' has starts of its own: it can be compared with a study's variant whose draws have "
        "the same ones (the same `demonstrations`, `starts`, `eval_seed` and `episodes`, and as many draws)."
    )


def _check_sources(a: Source, b: Source, asked: Asked) -> None:
    if a.arm == b.arm and (both := {*map(Path.resolve, a.folders)} & {*map(Path.resolve, b.folders)}):
        raise InputError(f"'{min(both)}' is on both sides; name another for one of them.")
    if asked.seed is not None and {a.kind, b.kind} != {CHECKPOINT}:
        raise InputError("The starts of these sides are known: leave out --seed.")


def _common_env(known: Collection[Side], asked: Asked) -> Mapping[str, Any]:
    """The environment that the known sides were evaluated in, or that was asked for.

    Raises:
        InputError: the environments differ, or none names a task.
    """
    if not known:
        if "task" not in asked.env:
            raise InputError("Neither side says in which task it was, or is to be, evaluated: add --task.")
        return asked.env
    first, *others = known
    for other in others:
        check_equal(f"'{first.name}' and '{other.name}'", first.env, other.env)
    check_equal(f"'{first.name}' and what was asked for", first.env, {**first.env, **asked.env})
    return first.env


def _common_starts(known: Collection[Side], asked: Asked) -> list[int]:
    """The first `asked.episodes` starts that all known sides have, or those that were asked for.

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
        ranges = " and ".join(f"'{side.name}' has {min(side.starts)} to {max(side.starts)}" for side in known)
        raise InputError(f"The sides have no start in common: {ranges}; evaluate one from the other's starts.")
    return common[: asked.episodes]
