"""A study as a file: what is trained on what, with which seeds, and where it is evaluated."""

import re
from collections import Counter
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any

from lerobot_constructskill.artifacts.pools import EXECUTORS
from lerobot_constructskill.bounds import (
    Among,
    Checked,
    Count,
    Pattern,
    Range,
    Seed,
    Text,
    Workers,
    check,
    check_fields,
)
from lerobot_constructskill.errors import InputError
from lerobot_constructskill.study.rows import OWN, SHARED, Draws
from lerobot_constructskill.training.recipe import Training

NAME = r"[a-z0-9][a-z0-9_-]*"
"""What studies, settings and variants are called: they name folders and videos, and stand in every row."""

Seeds = Annotated[int, Range(1, 1000)]


@dataclass(frozen=True)
class Setting:
    """A data set and the environment that its policies are evaluated in.

    Args:
        data: the demonstrations: a name or file that `constructskill-generate` takes, and flags over it, such as
            `fast --noise.sigma=0.005`.
        env: fields of `--env.type=constructskill`.
        training: fields of `Training` that differ from the study's.
    """

    data: Text
    env: dict[str, Any] = field(default_factory=dict)
    training: dict[str, Any] = field(default_factory=dict)


@dataclass(frozen=True)
class Variant:
    """A policy to train, once per seed and setting.

    Args:
        policy: fields of a LeRobot policy, `type` among them.
        seeds: how many training seeds, `first_seed` and those that follow it.
        data: demonstrations to use instead of the setting's, for an ablation of the data; flags alone, such as
            `--noise.sigma=0`, go over the setting's.
        dagger: what `constructskill-dagger` takes, a name or file and flags over it: each seed is trained on rounds
            too, which it drives itself. Only the rounds are as said there; demonstrations, policy, training and seed
            are the variant's.
        settings: names of the settings it runs in; all of them by default.
        training: fields of `Training` that differ from the setting's.
        first_seed: the first training seed; results are reported on seeds from 0 on, choices are made on others.
    """

    policy: dict[str, Any]
    seeds: Seeds = 10
    data: Text | None = None
    dagger: Text | None = None
    settings: list[str] | None = None
    training: dict[str, Any] = field(default_factory=dict)
    first_seed: Seed = 0

    @property
    def training_seeds(self) -> range:
        return range(self.first_seed, self.first_seed + self.seeds)


@dataclass(frozen=True)
class Study:
    """Runs to compare: every variant in every setting with every seed, and references.

    Args:
        name: what the study is called.
        settings: name to setting.
        variants: name to variant.
        references: what to run beside the variants in every setting, such as `expert`, to the number of seeds.
        training: the recipe.
        demonstrations: `shared`: the training seeds of a variant learn from the same data set, and differ in the
            initial weights and the order of the frames. `own`: each learns from a draw of its own, so that they differ
            in their demonstrations (and in the starts of DAgger's rounds) as well.
        starts: `shared`: all runs are evaluated from the same starts. `own`: each draw has starts of its own.
        seeds_a_draw: training seeds that share a draw of `own`: 3 means that seeds 0 to 2 have the first one.
        episodes: evaluation episodes of a run.
        eval_seed: seed of the first evaluation episode; episode i has seed `eval_seed + i`, and of `own` starts draw d
            begins at `eval_seed + d * episodes`.

    Raises:
        ValueError: a name or a number that cannot be used.
    """

    name: Annotated[str, Pattern(NAME, "a name of a-z, 0-9, '_' and '-'")]
    settings: dict[str, Setting]
    variants: dict[str, Variant]
    references: dict[str, int] = field(default_factory=dict)
    training: Training = field(default_factory=Training)
    demonstrations: Annotated[str, Among((SHARED, OWN))] = SHARED
    starts: Annotated[str, Among((SHARED, OWN))] = SHARED
    seeds_a_draw: Seeds = 1
    episodes: Count = 10
    eval_seed: Seed = 1000

    def __post_init__(self):
        check(self)
        for name in (*self.settings, *self.variants):
            if not re.fullmatch(NAME, name):
                raise InputError(f"'{name}' cannot name a setting or variant; use a-z, 0-9, '_' and '-'.")
        for kind in ("settings", "variants"):
            if not getattr(self, kind):
                raise InputError(f"A study needs at least one of {kind}.")
        for name, variant in self.variants.items():
            if variant.training_seeds.stop > 2**31:
                raise InputError(f"variants.{name}: its last training seed must be at most {2**31 - 1}.")
        names = [*self.settings, *self.variants, *self.references]
        if twice := [name for name in names if names.count(name) > 1]:
            raise InputError(
                f"'{twice[0]}' is the name of two things; settings, variants and references need different names."
            )
        for name, seeds in self.references.items():
            check_fields(Variant, {"seeds": seeds}, f"references.{name}: ")
        for name, setting in self.settings.items():
            check(setting, f"settings.{name}.")
        for name, variant in self.variants.items():
            check(variant, f"variants.{name}.")
            unknown = [setting for setting in variant.settings or [] if setting not in self.settings]
            if unknown:
                known = ", ".join(self.settings)
                raise InputError(f"Unknown setting '{unknown[0]}' of variant '{name}'; the settings are: {known}.")
            if variant.settings == []:
                raise InputError(f"Variant '{name}' must run in one setting or more; without `settings`, in all.")
            if "type" not in variant.policy:
                raise InputError(f"Variant '{name}' must name its policy's type, such as 'type: frozen_vit'.")
            if "holdout" in variant.training:
                raise InputError(
                    f"Variant '{name}': all variants of a setting hold out the same; give it to the setting."
                )
        if self.demonstrations == SHARED and (self.starts, self.seeds_a_draw) != (SHARED, 1):
            raise InputError("starts and seeds_a_draw are of draws: they need `demonstrations: own`.")
        if odd := next((name for name, one in self.variants.items() if one.seeds % self.seeds_a_draw), None):
            raise InputError(f"variants.{odd}.seeds must be a multiple of seeds_a_draw, {self.seeds_a_draw}.")
        if bare := [name for name in self.settings if not self.variants_in(name)]:
            raise InputError(f"No variant runs in the setting '{bare[0]}', so there would be nothing to report.")

        agents = [
            (setting, name) for setting in self.settings for name in (*self.variants_in(setting), *self.references)
        ]
        videos = Counter(video_path(*agent).stem for agent in agents)
        if same := [name for name, count in videos.items() if count > 1]:
            raise InputError(f"Two settings and variants are both '{same[0]}' when joined; rename one of them.")

    def variants_in(self, setting: str) -> dict[str, Variant]:
        """The variants that run in a setting, by name."""
        return {name: v for name, v in self.variants.items() if setting in (v.settings or self.settings)}

    @property
    def draws(self) -> Draws:
        return Draws(self.demonstrations, self.starts, self.seeds_a_draw)

    def starts_of(self, draw: int) -> range:
        """The evaluation episodes' seeds of a draw's runs."""
        first = self.eval_seed + (draw * self.episodes if self.starts == OWN else 0)
        return range(first, first + self.episodes)

    def data_for(self, setting: str, variant: Variant) -> str:
        """The demonstrations that a variant is trained on in a setting; for DAgger they are labelled as its rounds."""
        own, other = self.settings[setting].data, variant.data or ""
        data = f"{own} {other}".strip() if other.startswith("--") else other or own
        return f"{data} --labels=advice" if variant.dagger and "--labels" not in data else data

    def data_of(self, setting: str) -> list[str]:
        """All demonstrations that the setting's variants are trained on, its own first.

        Every policy of the setting is validated on what is held out of each of them. (The paper validates its policy
        without noise on demonstrations without noise, section IV.)
        """
        data = (self.data_for(setting, variant) for variant in self.variants_in(setting).values())
        return list(dict.fromkeys([self.settings[setting].data, *data]))


def video_path(setting: str, name: str) -> Path:
    """Where the video of a variant or reference in a setting lies in a study's folder."""
    return Path("videos") / f"{setting}-{name}.mp4"


@dataclass(frozen=True)
class Options(Checked):
    """How a study is run.

    Args:
        only: make only the runs setting/variant/seed_N that match, such as `fixed` or `fixed/*/seed_[0-4]`; several
            separated by commas. They are not validated on demonstrations of others.
        together: seeds that are trained and evaluated in one pass.
        executor: "processes" (this machine) or "ray" (extra `distributed`; a cluster needs the study's folder and the
            store on a file system that all its machines share).
        workers: processes that generate demonstrations and simulate in rounds of DAgger; jobs at a time on a Ray of
            this machine.
        retry_failed: make runs again that failed before.
        replace: drop rows that other code, packages or weights made and that the store does not keep, those of a
            setting's variant as soon as one of its runs is made anew. Without it such a folder is refused.

    Raises:
        ValueError: a count below 1 or an unknown executor.
    """

    only: str = ""
    together: Count = 10
    executor: Annotated[str, Among(EXECUTORS)] = "processes"
    workers: Workers = 2
    retry_failed: bool = False
    replace: bool = False
