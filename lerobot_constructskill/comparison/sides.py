"""One side of a comparison: training seeds of a policy, where they were evaluated, and the result of each start."""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from typing import Any

from lerobot_constructskill.contract import OBS_TYPES, get_task
from lerobot_constructskill.errors import InputError
from lerobot_constructskill.perturbations import Perturbation

Placements = Mapping[int, bool]
"""Start (seed of an evaluation episode) to whether the episode placed the object."""


@dataclass
class Side:
    """One side of a comparison.

    Args:
        name: what the user called it.
        kind: what it was read from, such as "10 training seeds of a study".
        env: keyword arguments of the `ConstructSkillEnv` that it was evaluated in; None if unknown.
        seeds: placements of each training seed; None for a seed whose training or evaluation failed.
        versions: packages, processor and simulator that its episodes were made with.
    """

    name: str
    kind: str
    env: Mapping[str, Any] | None = None
    seeds: list[Placements | None] = field(default_factory=list)
    versions: dict[str, str] = field(default_factory=dict)

    @property
    def starts(self) -> set[int] | None:
        """Starts that all training seeds were evaluated from; None if every seed failed."""
        finished = [set(placed) for placed in self.seeds if placed is not None]
        return set.intersection(*finished) if finished else None


def conditions(env: Mapping[str, Any]) -> dict[str, Any]:
    """Everything that must be equal for two episodes from the same start to be comparable.

    Args:
        env: keyword arguments of `ConstructSkillEnv`; missing ones have its defaults.

    Raises:
        InputError: there is no such task, perturbation or observation.
    """
    task, obs_type = get_task(env["task"]), env.get("obs_type") or next(iter(OBS_TYPES))
    perturbation = Perturbation(env.get("perturb") or "", env.get("perturb_seed") or 0)
    perturbation.check(task)
    if obs_type not in OBS_TYPES:
        raise InputError(f"obs_type must be one of {', '.join(OBS_TYPES)}, not '{obs_type}'.")
    return {
        "task": task.name,
        "episode_length": env.get("episode_length") or task.horizon,
        "obs_type": obs_type,
        "perturbation": perturbation.label,
    }


def check_equal(who: str, one: Mapping[str, Any], other: Mapping[str, Any]) -> None:
    """Check that two environments have equal conditions.

    Raises:
        InputError: they differ; the message begins with `who`.
    """
    one, other = conditions(one), conditions(other)
    different = [
        f"{name} ({one[name] or 'none'}, {other[name] or 'none'})" for name in one if one[name] != other[name]
    ]
    if different:
        raise InputError(f"{who} cannot be compared: they differ in {', '.join(different)}.")


def merge_versions(many: Iterable[Mapping[str, Any]]) -> dict[str, str]:
    """Merge the versions of several runs: each name with all its different values."""
    merged: dict[str, dict[str, None]] = {}
    for versions in many:
        for name, value in versions.items():
            merged.setdefault(name, {})[str(value)] = None
    return {name: ", ".join(values) for name, values in merged.items()}
