"""The numbers of a report: a study has settings, a setting has variants and comparisons."""

from dataclasses import dataclass
from typing import NamedTuple

import pandas as pd

from lerobot_constructskill.analysis.stats.comparisons import Comparison
from lerobot_constructskill.analysis.stats.components import Components
from lerobot_constructskill.analysis.stats.correlation import Correlation
from lerobot_constructskill.analysis.stats.intervals import Estimate
from lerobot_constructskill.analysis.stats.outcomes import Counts
from lerobot_constructskill.analysis.stats.walls import Wall


class Success(NamedTuple):
    """How often one variant met one criterion.

    Args:
        counts: seeds that met it in at least one episode. Where there are several draws of demonstrations, these stand
            for seeds, here and below.
        exact: share of those seeds with Clopper-Pearson's interval.
        mean: share of episodes, averaged over seeds, with Gaffke's interval.
        worst: the smallest of these shares.
        spread: standard deviation of that share over seeds (divisor n), in [0, 0.5].
        chance: the same, were all seeds alike, as `spread_by_chance` says; None where draws stand for seeds, a seed
            failed, seeds have different starts, or there is one start.
    """

    counts: Counts
    exact: Estimate
    mean: Estimate
    worst: float
    spread: float
    chance: float | None


@dataclass(frozen=True, eq=False)
class VariantFindings:
    """A variant or a reference in one setting.

    Args:
        name: name in the rows.
        label: name in tables.
        demonstrations: name of the data set that it was trained on; None without one.
        training_seeds: planned seeds, in order.
        runs: runs that were made, as rows of `runs_of`, with their `draw` and `unit`.
        success: criterion to success; empty if no run finished, so that missing runs never look like zeros.
        error: held-out error in m2, mean and range over seeds; None if it is unknown.
        errors_by_data: the same on each data set of the setting.
        components: what the spread of the share of placed episodes is made of, where that can be told.
        wall: what was laid, where the task is a plan.
    """

    name: str
    label: str
    demonstrations: str | None
    training_seeds: tuple[int, ...]
    runs: pd.DataFrame
    success: dict[str, Success]
    error: Estimate | None
    errors_by_data: dict[str, Estimate | None]
    components: Components | None
    wall: Wall | None = None

    @property
    def seeds(self) -> int:
        return len(self.training_seeds)

    @property
    def failures(self) -> pd.DataFrame:
        """Rows of `runs` that failed."""
        return self.runs[self.runs["error_kind"].notna()]

    @property
    def measured(self) -> str:
        """Of how many runs the held-out error is, where it is not of all."""
        known, runs = self.runs["heldout_mse_m2"].count(), len(self.runs)
        return f" (of {known} of {runs} seeds)" if 0 < known < runs else ""

    @property
    def absence(self) -> str:
        """Why `success` is empty."""
        return "not run yet" if self.failures.empty else "no run finished"


class SeedGroup(NamedTuple):
    """Variants with equally many seeds.

    Args:
        seeds: number of seeds of each variant.
        variants: the variants.
        baseline: the setting's first variant, cut to its first `seeds` seeds; None if it has no more than those.
    """

    seeds: int
    variants: list[VariantFindings]
    baseline: VariantFindings | None


@dataclass(frozen=True, eq=False)
class SettingFindings:
    """What one setting shows.

    Args:
        name: name in the rows.
        label: name in the report.
        variants: variants in the order of the analysis.
        references: floors and ceilings.
        data_sets: names of data sets with a known held-out error, the setting's own first.
        groups: variants by number of seeds, most seeds first.
        declared: number of declared comparisons.
        comparisons: criterion to the declared comparisons that could be made.
        correlations: (label, criterion to Kendall's tau of held-out error and episodes), all variants together first.
    """

    name: str
    label: str
    variants: list[VariantFindings]
    references: list[VariantFindings]
    data_sets: list[str]
    groups: list[SeedGroup]
    declared: int
    comparisons: dict[str, list[Comparison]]
    correlations: list[tuple[str, dict[str, Correlation | None]]]

    @property
    def everything(self) -> list[VariantFindings]:
        """Variants, then references."""
        return [*self.variants, *self.references]

    @property
    def validated(self) -> list[VariantFindings]:
        """Variants with a known held-out error."""
        return [one for one in self.variants if one.error is not None]

    @property
    def repeated(self) -> list[VariantFindings]:
        """Variants with several seeds, or draws, that have results."""
        return [one for one in self.variants if one.success and one.success["placed"].counts.seeds > 1]

    @property
    def drawn(self) -> list[VariantFindings]:
        """Variants whose draws, seeds and starts can be told apart."""
        return [one for one in self.variants if one.components]

    @property
    def walls(self) -> list[VariantFindings]:
        """Variants and references whose episodes were measured as walls."""
        return [one for one in self.everything if one.wall]

    @property
    def labels(self) -> dict[str, str]:
        """Variant to label."""
        return {variant.name: variant.label for variant in self.variants}


@dataclass(frozen=True, eq=False)
class Sweep:
    """Settings that differ in one thing.

    Args:
        label: what is varied.
        settings: the settings, the one without the variation first.
    """

    label: str
    settings: list[SettingFindings]

    def find(self, label: str) -> list[tuple[SettingFindings, VariantFindings]]:
        """The variant or reference of that label in every setting that has one."""
        return [(setting, one) for setting in self.settings for one in setting.everything if one.label == label]


@dataclass(frozen=True, eq=False)
class Findings:
    """What a study shows.

    Args:
        settings: findings of each setting.
        means: settings that stand for the mean over several.
        sweeps: settings that differ in one thing.
        alpha: level of the tests.
        episodes: evaluation episodes of a run.
        first_seed, last_seed: smallest and largest seed of an evaluation episode.
        planned: number of planned runs of variants.
        planned_references: number of planned runs of references.
        missing: planned runs of variants and references that were not made.
    """

    settings: list[SettingFindings]
    means: list[SettingFindings]
    sweeps: list[Sweep]
    alpha: float
    episodes: int
    first_seed: int
    last_seed: int
    planned: int
    planned_references: int
    missing: int

    @property
    def sections(self) -> list[SettingFindings]:
        """Settings with a section: a sweep's later ones have it if they compare variants or split a spread."""
        swept = {setting.name for sweep in self.sweeps for setting in sweep.settings[1:]}
        return [
            setting
            for setting in self.settings
            if setting.name not in swept or len(setting.variants) > 1 or setting.drawn
        ]

    @property
    def swept_labels(self) -> list[str]:
        """Labels of the variants, then of the references, that run in sweeps."""
        settings = [setting for sweep in self.sweeps for setting in sweep.settings]
        variants = [one.label for setting in settings for one in setting.variants]
        references = [one.label for setting in settings for one in setting.references]
        return list(dict.fromkeys([*variants, *references]))

    @property
    def failures(self) -> list[tuple[str, str, list[int], str]]:
        """(setting, variant, training seeds, error) of the failed runs."""
        return [
            (setting.label, one.label, list(runs["training_seed"]), error)
            for setting in self.settings
            for one in setting.everything
            for error, runs in one.failures.groupby("error", sort=False)
        ]
