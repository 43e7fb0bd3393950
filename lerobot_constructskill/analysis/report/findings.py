"""The shapes of what a report says, as numbers: a study has settings, a setting has lines and comparisons."""

from dataclasses import dataclass
from itertools import chain
from typing import NamedTuple

import pandas as pd

from lerobot_constructskill.analysis.stats.comparisons import Comparison
from lerobot_constructskill.analysis.stats.correlation import Correlation
from lerobot_constructskill.analysis.stats.intervals import Estimate
from lerobot_constructskill.analysis.stats.outcomes import Counts

WEIGHTS = "weights"
"""`error_kind` of a run whose backbone could be had from nowhere; what it tried stands among the failed runs."""


class Outcome(NamedTuple):
    """One variant on one criterion.

    Args:
        counts: seeds that met it.
        exact: their share with Clopper-Pearson's interval.
        mean: share of episodes, averaged over seeds.
        spread: its standard deviation over seeds (divisor n), in [0, 0.5].
    """

    counts: Counts
    exact: Estimate
    mean: Estimate
    spread: float


@dataclass(frozen=True, eq=False)
class Line:
    """A variant or a reference in one setting.

    Args:
        name, label: what the rows and what tables call it.
        role: as in the rows.
        demonstrations: name of the data set that it was trained on; None without one.
        training_seeds: those that are planned, in order.
        runs: its runs that were made, lines of `seed_outcomes`.
        outcomes: criterion to outcome; empty where no run finished without an error, so that policies that could
            not be had never look like zeros.
        error: held-out error in m2, mean with its range over seeds; None without any.
        errors_by_data: the same on each data set of the setting.
    """

    name: str
    label: str
    role: str
    demonstrations: str | None
    training_seeds: tuple[int, ...]
    runs: pd.DataFrame
    outcomes: dict[str, Outcome]
    error: Estimate | None
    errors_by_data: dict[str, Estimate | None]

    @property
    def seeds(self) -> int:
        return len(self.training_seeds)

    @property
    def failures(self) -> pd.DataFrame:
        """Its failed runs."""
        return self.runs[self.runs["error_kind"].notna()]

    @property
    def failed(self) -> int:
        return len(self.failures)

    @property
    def absence(self) -> str:
        """Why there are no outcomes."""
        if self.failures.empty:
            return "not run yet"
        return "weights not available" if self.lacks_weights else f"no run finished: {self.failures['error'].iloc[0]}"

    @property
    def lacks_weights(self) -> bool:
        """Whether every run failed for want of a backbone's weights."""
        return self.failed > 0 and bool((self.failures["error_kind"] == WEIGHTS).all())


class Table(NamedTuple):
    """Variants with equally many seeds; `baseline` is the first variant's first seeds where it has more."""

    seeds: int
    lines: list[Line]
    baseline: Line | None = None

    @property
    def spans(self) -> list[tuple[int, int]]:
        """First and last training seed of its variants, each span once."""
        return sorted({(line.training_seeds[0], line.training_seeds[-1]) for line in self.lines})


class RateTest(NamedTuple):
    """Two variants' shares of episodes over seeds: do they differ in mean, do they differ in spread?

    Args:
        a, b: the variants.
        mean: mean of a minus mean of b.
        mean_holm: its p-value from a permutation of seeds, corrected over the declared family.
        spread: standard deviation of a minus that of b.
        spread_holm: its p-value, likewise.
    """

    a: str
    b: str
    mean: float
    mean_holm: float
    spread: float
    spread_holm: float


@dataclass(frozen=True, eq=False)
class SettingFindings:
    """What one setting shows.

    Args:
        name, label: what the rows and what tables call it.
        lines: its variants, in the analysis' order.
        references: floors and ceilings.
        data_sets: names of those that errors are known on, the setting's own first.
        tables: the variants by number of seeds, most seeds first.
        comparisons: criterion to the declared comparisons that could be made.
        declared: how many comparisons are declared here.
        rate_tests: criterion to the same pairs' mean and spread over seeds.
        correlations: criterion to (label, Kendall's tau of held-out error and episodes), over all variants first.
    """

    name: str
    label: str
    lines: list[Line]
    references: list[Line]
    data_sets: list[str]
    tables: list[Table]
    comparisons: dict[str, list[Comparison]]
    declared: int
    rate_tests: dict[str, list[RateTest]]
    correlations: dict[str, list[tuple[str, Correlation | None]]]

    @property
    def everything(self) -> list[Line]:
        return [*self.lines, *self.references]

    @property
    def all_or_nothing(self) -> bool:
        """Whether the runs of variants placed in all of their episodes or in none."""
        shares = pd.concat([line.runs["placed_rate"] for line in self.lines])
        return bool(shares.isin([0, 1]).all())

    @property
    def labels(self) -> dict[str, str]:
        return {line.name: line.label for line in self.everything}

    @property
    def failures(self) -> list[tuple[str, list[int], str]]:
        """(label, seeds, error) of the failed runs."""
        return [
            (line.label, [int(seed) for seed in runs["training_seed"]], str(error))
            for line in self.everything
            for error, runs in line.failures.groupby("error", sort=False)
        ]

    @property
    def failed_seeds(self) -> int:
        """Failed runs among runs that finished: they count as seeds that met no criterion."""
        return sum(line.failed for line in self.everything if line.outcomes)


@dataclass(frozen=True, eq=False)
class Sweep:
    """What comes of varying one thing.

    Args:
        label: what it is called.
        settings: those that differ in it, the one without it first.
    """

    label: str
    settings: list[SettingFindings]

    def lines(self, label: str) -> list[tuple[SettingFindings, Line]]:
        """What is called so, a variant or a reference, in each setting where it runs."""
        return [(setting, line) for setting in self.settings for line in setting.everything if line.label == label]


@dataclass(frozen=True, eq=False)
class Findings:
    """What a study shows.

    Args:
        settings: what each setting shows.
        sweeps: what comes of varying one thing at a time.
        alpha: level of its tests.
        episodes: evaluation episodes of a run.
        first_seed: seed of the first of them.
        planned: runs of variants that the study has, made or not.
        planned_references: the same of floors and ceilings.
        missing: planned runs of variants without a result.
        missing_references: (setting's label, reference's label) without a result.
        repeated: of the runs with several episodes, (those whose episodes all ended alike, all of them).
    """

    settings: list[SettingFindings]
    sweeps: list[Sweep]
    alpha: float
    episodes: int
    first_seed: int
    planned: int
    planned_references: int
    missing: int
    missing_references: list[tuple[str, str]]
    repeated: tuple[int, int]

    @property
    def sections(self) -> list[SettingFindings]:
        """The settings with a section of their own: what a sweep goes on to has one where it compares variants."""
        swept = {setting.name for sweep in self.sweeps for setting in sweep.settings[1:]}
        return [setting for setting in self.settings if setting.name not in swept or len(setting.lines) > 1]

    @property
    def swept_lines(self) -> list[Line]:
        """The variants, and then the references, that run in sweeps: a line of each label."""
        settings = list(chain.from_iterable(sweep.settings for sweep in self.sweeps))
        lines: dict[str, Line] = {}
        for line in chain(*(setting.lines for setting in settings), *(setting.references for setting in settings)):
            lines.setdefault(line.label, line)
        return list(lines.values())

    @property
    def failures(self) -> list[tuple[str, str, list[int], str]]:
        """(setting's label, label, seeds, error) of the failed runs."""
        return [(setting.label, *failure) for setting in self.settings for failure in setting.failures]
