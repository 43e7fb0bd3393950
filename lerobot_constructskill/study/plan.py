"""A study as a file: what is trained on what, with which seeds, and where it is evaluated."""

import hashlib
import json
import re
from dataclasses import asdict, dataclass, field
from itertools import combinations
from typing import Any

from lerobot_constructskill.contract import HELD_OUT_EVERY, get_task
from lerobot_constructskill.errors import InputError

REFERENCES = ("no_op", "random", "replay", "blind", "untrained", "expert")
"""Floors and ceilings that a study can run beside its variants."""

NAME = re.compile(r"[a-z0-9][a-z0-9_-]*")
"""What settings and variants are called: they name folders and stand in every row."""


@dataclass(frozen=True)
class Setting:
    """A data set and the environment that its policies are evaluated in.

    Args:
        data: the configuration of `constructskill-generate` that makes the demonstrations.
        env: fields of `--env.type=constructskill`.
        label: what tables call it; its name by default.
    """

    data: str
    env: dict[str, Any] = field(default_factory=dict)
    label: str | None = None


@dataclass(frozen=True)
class Variant:
    """A policy to train, once per seed and setting.

    Args:
        policy: fields of a LeRobot policy, `type` among them.
        seeds: training seeds 0 to `seeds` - 1.
        data: another `constructskill-generate` configuration than the setting's, for an ablation of the data.
        settings: names of the settings it runs in; all of them by default.
        training: fields of `Training` that differ from the study's.
        label: what tables call it; its name by default.
    """

    policy: dict[str, Any]
    seeds: int = 10
    data: str | None = None
    settings: list[str] | None = None
    training: dict[str, Any] = field(default_factory=dict)
    label: str | None = None


@dataclass(frozen=True)
class Training:
    """How every variant is trained (spec, section 4). Learning rate and weight decay are the policy's.

    Args:
        epochs: passes over the demonstrations that are not held out.
        batch_size: frames per step.
        holdout: one demonstration of so many is held out.
    """

    epochs: int = 150
    batch_size: int = 256
    holdout: int = HELD_OUT_EVERY


@dataclass(frozen=True)
class Run:
    """One training seed of one variant in one setting, the unit of evidence; or one of a reference."""

    setting: str
    variant: str
    seed: int
    is_reference: bool = False

    @property
    def id(self) -> str:
        return f"{self.setting}/{self.variant}/seed_{self.seed}"


@dataclass(frozen=True)
class StudyPlan:
    """A study.

    Args:
        name: what the study is called.
        settings: name to setting.
        variants: name to variant.
        references: floors and ceilings to run in every setting, some of `REFERENCES`, to the number of their seeds.
        training: the recipe.
        episodes: evaluation episodes of a run.
        eval_seed: seed of the first evaluation episode; episode i has seed `eval_seed + i`.
        comparisons: pairs of variants that the study declares it will test, the family that Holm's correction covers;
            every pair with equally many seeds by default.
        alpha: level of those tests.

    Raises:
        ValueError: a name, count or reference that no study can be run with.
    """

    name: str
    settings: dict[str, Setting]
    variants: dict[str, Variant]
    references: dict[str, int] = field(default_factory=dict)
    training: Training = field(default_factory=Training)
    episodes: int = 10
    eval_seed: int = 1000
    comparisons: list[list[str]] | None = None
    alpha: float = 0.05

    def __post_init__(self):
        for name in (self.name, *self.settings, *self.variants):
            if not NAME.fullmatch(name):
                raise InputError(f"'{name}' is no name for a study, setting or variant; use a-z, 0-9, '_' and '-'.")
        if taken := [name for name in self.variants if name in REFERENCES]:
            raise InputError(f"'{taken[0]}' is the name of a reference; call the variant something else.")
        for kind in ("settings", "variants"):
            if not getattr(self, kind):
                raise InputError(f"A study needs at least one of {kind}.")
        _check_known("reference", list(self.references), REFERENCES)
        counts = {"episodes": self.episodes, **self.references}
        for name, count in counts.items():
            if count < 1:
                raise InputError(f"{name} must be at least 1, not {count}.")
        if not 0 < self.alpha < 1:
            raise InputError(f"alpha must lie between 0 and 1, not {self.alpha}.")
        for setting in self.settings.values():
            get_task(setting.env.get("task", "brick_to_bin"))
        for name, variant in self.variants.items():
            _check_known(f"setting of variant '{name}'", variant.settings or [], self.settings)
            if variant.seeds < 1:
                raise InputError(f"Variant '{name}' needs at least one seed, not {variant.seeds}.")
            if "type" not in variant.policy:
                raise InputError(f"Variant '{name}' must name its policy's type, such as 'type: frozen_vit'.")
        for pair in self.comparisons or []:
            _check_known("variant in comparisons", pair, self.variants)
            if len(pair) != 2:
                raise InputError(f"A comparison is a pair of variants, not {pair}.")

    @property
    def runs(self) -> list[Run]:
        """Every run of a variant, setting by setting and variant by variant."""
        return [
            Run(setting, name, seed)
            for setting in self.settings
            for name, variant in self.variants_in(setting).items()
            for seed in range(variant.seeds)
        ]

    @property
    def reference_runs(self) -> list[Run]:
        """Every run of a floor or ceiling."""
        return [
            Run(setting, name, seed, is_reference=True)
            for setting in self.settings
            for name, seeds in self.references.items()
            for seed in range(seeds)
        ]

    def data_of(self, setting: str) -> list[str]:
        """Every `constructskill-generate` configuration in a setting, its own first.

        Every `frozen_vit` policy of the setting is validated on what is held out of each of them. (The
        paper validates its policy without noise on demonstrations without noise, section IV.)
        """
        data = (variant.data for variant in self.variants_in(setting).values() if variant.data)
        return list(dict.fromkeys([self.settings[setting].data, *data]))

    def variants_in(self, setting: str) -> dict[str, Variant]:
        """The variants that run in a setting, by name."""
        return {name: v for name, v in self.variants.items() if setting in (v.settings or self.settings)}

    def variant_of(self, run: Run) -> Variant:
        """What a run trains; `blind` and `untrained` are the first frozen_vit variant, with other eyes.

        Raises:
            ValueError: the plan has no frozen_vit variant for them.
        """
        if not run.is_reference:
            return self.variants[run.variant]
        for variant in self.variants.values():
            if variant.policy["type"] == "frozen_vit":
                return variant
        raise InputError(f"The reference '{run.variant}' needs a variant of type frozen_vit to be made from.")

    @property
    def pairs(self) -> list[tuple[str, str]]:
        """The declared comparisons."""
        if self.comparisons is not None:
            return [(a, b) for a, b in self.comparisons]
        names = combinations(self.variants, 2)
        return [(a, b) for a, b in names if self.variants[a].seeds == self.variants[b].seeds]

    @property
    def sha256(self) -> str:
        """Hash of everything in the plan: rows of another plan are never mixed with this one's."""
        return hashlib.sha256(json.dumps(asdict(self), sort_keys=True).encode()).hexdigest()


def _check_known(what: str, given: list[str], known) -> None:
    unknown = [name for name in given if name not in known]
    if unknown:
        raise InputError(f"Unknown {what} '{unknown[0]}'; there are: {', '.join(known)}.")
