"""A side of a comparison: the training seeds of one policy, where they were evaluated, and what came of each start."""

import json
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, fields
from typing import Any

from lerobot_constructskill.contract import OBS_TYPES, get_task
from lerobot_constructskill.errors import InputError, plural
from lerobot_constructskill.perturbations import Perturbation

Outcomes = Mapping[int, bool]
"""Seed of an evaluation episode, which decides its start, to whether the episode placed."""


@dataclass(frozen=True)
class Conditions:
    """What has to be the same for two episodes from the same start to be comparable.

    Args:
        task: name of the task.
        episode_length: steps after which an episode ends.
        obs_type: what the policy is shown.
        perturb, perturb_seed: as of `ConstructSkillEnv`.

    Raises:
        InputError: there is no such task, perturbation or observation.
    """

    task: str
    episode_length: int
    obs_type: str
    perturb: str
    perturb_seed: int

    def __post_init__(self):
        Perturbation(self.perturb, self.perturb_seed).check(get_task(self.task))
        if self.obs_type not in OBS_TYPES:
            raise InputError(f"obs_type must be one of {', '.join(OBS_TYPES)}, not '{self.obs_type}'.")

    @classmethod
    def of(cls, env: Mapping[str, Any]) -> "Conditions":
        """Those of keyword arguments of `ConstructSkillEnv`, with its defaults."""
        length = env.get("episode_length") or get_task(env["task"]).horizon
        defaults = {"obs_type": next(iter(OBS_TYPES)), "perturb": "", "perturb_seed": 0}
        told = {name: env.get(name) or default for name, default in defaults.items()}
        return cls(task=env["task"], episode_length=length, **told)

    def differences(self, other: "Conditions") -> list[str]:
        """What differs, each with both values."""
        pairs = {one.name: (getattr(self, one.name), getattr(other, one.name)) for one in fields(self)}
        for pair in ("perturb", "perturb_seed"):
            del pairs[pair]
        labels = [Perturbation(one.perturb, one.perturb_seed).label or "none" for one in (self, other)]
        return [f"{name} ({a}, {b})" for name, (a, b) in (pairs | {"perturbation": labels}).items() if a != b]

    def __str__(self) -> str:
        label = Perturbation(self.perturb, self.perturb_seed).label
        return f"{self.task}{label}, at most {plural(self.episode_length, 'step')}, {self.obs_type}"


@dataclass
class Side:
    """One side, as far as it is known.

    Args:
        name: what the user called it.
        kind: what it was read from, such as "10 training seeds of a published study".
        env: keyword arguments of `ConstructSkillEnv` where it was evaluated; None where nothing says so.
        seeds: the outcomes of each training seed; None for one whose training or evaluation failed.
        versions: packages, processor and simulator that its episodes were made with.
    """

    name: str
    kind: str
    env: Mapping[str, Any] | None = None
    seeds: list[Outcomes | None] = field(default_factory=list)
    versions: dict[str, str] = field(default_factory=dict)

    @property
    def conditions(self) -> Conditions | None:
        return Conditions.of(self.env) if self.env is not None else None

    @property
    def starts(self) -> set[int] | None:
        """Those that all of its seeds were evaluated from; None before they are evaluated."""
        finished = [set(outcomes) for outcomes in self.seeds if outcomes is not None]
        return set.intersection(*finished) if finished else None


def merge_versions(told: Iterable[Mapping[str, Any]]) -> dict[str, str]:
    """What several runs say of their making, every value that any of them has."""
    merged: dict[str, dict[str, None]] = {}
    for one in told:
        for name, value in one.items():
            merged.setdefault(name, {})[str(value)] = None
    return {name: ", ".join(values) for name, values in merged.items()}


MAKER = "processor's maker"
"""What recordings say of the processor, where a study's rows have its name."""


def read_versions(text: str | None, **others: Any) -> dict[str, Any]:
    """The versions that a row or a recording has as JSON, and other facts of its making that are not None."""
    return json.loads(text or "{}") | {name: value for name, value in others.items() if value}
