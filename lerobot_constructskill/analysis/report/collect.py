"""Rows and how to read them in, everything a report says out, as numbers."""

import json
from itertools import combinations, groupby

import numpy as np
import pandas as pd

from lerobot_constructskill.analysis.report.findings import (
    Findings,
    Line,
    Outcome,
    RateTest,
    SettingFindings,
    Sweep,
    Table,
)
from lerobot_constructskill.analysis.section import Analysis
from lerobot_constructskill.analysis.stats.comparisons import compare, holm
from lerobot_constructskill.analysis.stats.correlation import Correlation, kendall
from lerobot_constructskill.analysis.stats.intervals import Estimate, clopper_pearson
from lerobot_constructskill.analysis.stats.outcomes import CRITERIA, RUN, count, seed_outcomes
from lerobot_constructskill.analysis.stats.spread import mean_p_value, mean_rate, spread_p_value
from lerobot_constructskill.errors import InputError
from lerobot_constructskill.study.rows import NOT_RUN, VARIANT

Pairs = list[tuple[str, str]]


def collect(analysis: Analysis, rows: pd.DataFrame) -> Findings:
    """Compute what a report says. The same rows give the same numbers, intervals by resampling included.

    Args:
        analysis: how to read the rows.
        rows: one line per episode, from `study.rows.read_rows`.

    Raises:
        InputError: there are no rows, they contradict each other, or `analysis` names what they do not.
    """
    check_rows(rows)
    planned, runs = rows.drop_duplicates(RUN), seed_outcomes(rows)
    of_variants = planned["role"] == VARIANT
    variants, references = (list(planned.loc[chosen, "variant"].unique()) for chosen in (of_variants, ~of_variants))
    analysis.check(variants, list(planned["setting"].unique()), references)
    settings = [
        _setting(analysis, name, own, runs[runs["setting"] == name])
        for name, own in planned.groupby("setting", sort=False)
    ]
    by_name = {setting.name: setting for setting in settings}
    missing = planned["error_kind"].fillna("") == NOT_RUN
    return Findings(
        settings=settings,
        sweeps=[
            Sweep(analysis.label(name), [by_name[setting] for setting in swept])
            for name, swept in analysis.sweeps.items()
        ],
        alpha=analysis.alpha,
        episodes=int(rows["episodes"].iloc[0]),
        first_seed=int(rows["evaluation_seed"].min()),
        planned=int(of_variants.sum()),
        planned_references=int((~of_variants).sum()),
        missing=int((missing & of_variants).sum()),
        missing_references=[(s.label, line.label) for s in settings for line in s.references if line.runs.empty],
        repeated=_repeated(runs),
    )


def check_rows(rows: pd.DataFrame) -> None:
    """Raise InputError unless `rows` hold variants in every setting, and equally many episodes a run, each once."""
    if rows.empty:
        raise InputError("The study's table has no rows.")
    with_variants = set(rows.loc[rows["role"] == VARIANT, "setting"])
    if bare := [name for name in rows["setting"].unique() if name not in with_variants]:
        raise InputError(f"Setting '{bare[0]}' has no variant to report.")
    if len(lengths := sorted(rows["episodes"].unique())) > 1:
        raise InputError(f"One table has runs of {lengths[0]} and of {lengths[1]} episodes; report them separately.")
    finished = rows[rows["error_kind"].isna()]
    if bare := [name for name in CRITERIA if finished[name].isna().any()]:
        raise InputError(f"Whether an episode of a run that finished was {bare[0]} is missing in its row.")
    twice = rows.duplicated([*RUN, "episode"])
    if twice.any():
        row = rows[twice].iloc[0]
        raise InputError(
            f"Episode {row['episode']} of {row['setting']}/{row['variant']}/seed_{row['training_seed']} is in the "
            "rows twice; every episode must be counted once."
        )


def _repeated(runs: pd.DataFrame) -> tuple[int, int]:
    several = runs[runs["episodes"] > 1]
    alike = [several[criterion].isin([0]) | (several[criterion] == several["episodes"]) for criterion in CRITERIA]
    return int((alike[0] & alike[1]).sum()), len(several)


def _setting(analysis: Analysis, name: str, planned: pd.DataFrame, runs: pd.DataFrame) -> SettingFindings:
    """One setting. All but tables is computed in the order of the rows: another order shows the same numbers."""
    of_variants = planned["role"] == VARIANT
    lines = _lines(analysis, planned[of_variants], runs)
    references = _lines(analysis, planned[~of_variants], runs)
    ordered = sorted(lines, key=lambda line: analysis.rank(line.name))
    tables = _tables(ordered, planned)
    made = {line.name: line for line in lines if line.outcomes}
    pairs = _pairs(analysis, lines)
    comparisons = {
        criterion: compare({n: line.outcomes[criterion].counts for n, line in made.items()}, pairs, analysis.alpha)
        for criterion in CRITERIA
    }
    return SettingFindings(
        name=name,
        label=analysis.label(name),
        lines=ordered,
        references=references,
        data_sets=_data_sets(runs),
        tables=tables,
        comparisons=comparisons,
        declared=len(pairs),
        rate_tests={criterion: _rate_tests(made, pairs, criterion) for criterion in CRITERIA},
        correlations={criterion: _correlations(lines, ordered, criterion) for criterion in CRITERIA},
    )


def _pairs(analysis: Analysis, lines: list[Line]) -> Pairs:
    """The declared comparisons of a setting."""
    if analysis.comparisons is None:
        return [(a.name, b.name) for a, b in combinations(lines, 2) if a.seeds == b.seeds]
    names = {line.name for line in lines}
    return [(a, b) for a, b in analysis.comparisons if {a, b} <= names]


def _lines(analysis: Analysis, planned: pd.DataFrame, runs: pd.DataFrame) -> list[Line]:
    return [
        _line(analysis.label(name), own, runs[runs["variant"] == name])
        for name, own in planned.groupby("variant", sort=False)
    ]


def _line(label: str, planned: pd.DataFrame, runs: pd.DataFrame) -> Line:
    finished = runs["error_kind"].isna().any()
    by_data = pd.DataFrame([json.loads(errors) for errors in runs["heldout_mse_m2_by_data"].dropna()])
    demonstrations = planned["demonstrations"].dropna()
    return Line(
        name=planned["variant"].iloc[0],
        label=label,
        role=planned["role"].iloc[0],
        demonstrations=None if demonstrations.empty else demonstrations.iloc[0],
        training_seeds=tuple(sorted(planned["training_seed"])),
        runs=runs,
        outcomes={criterion: _outcome(runs, criterion) for criterion in CRITERIA} if finished else {},
        error=_mean_and_range(runs["heldout_mse_m2"]),
        errors_by_data={data: _mean_and_range(by_data[data]) for data in by_data},
    )


def _mean_and_range(errors: pd.Series) -> Estimate | None:
    known = errors.dropna().astype(float)
    return Estimate(*map(float, (known.mean(), known.min(), known.max()))) if len(known) else None


def _outcome(runs: pd.DataFrame, criterion: str) -> Outcome:
    counts, rates = count(runs, criterion), runs[f"{criterion}_rate"].to_numpy()
    return Outcome(counts, clopper_pearson(counts), mean_rate(rates), float(rates.std()))


def _data_sets(runs: pd.DataFrame) -> list[str]:
    """The setting's own, which `heldout_mse_m2` is of, and then the others."""
    known = runs.dropna(subset="heldout_mse_m2_by_data")
    errors = list(zip(known["heldout_mse_m2_by_data"].map(json.loads), known["heldout_mse_m2"], strict=True))
    names = dict.fromkeys(name for by_data, _ in errors for name in by_data)
    return sorted(names, key=lambda name: not any(by_data[name] == own for by_data, own in errors if name in by_data))


def _tables(lines: list[Line], planned: pd.DataFrame) -> list[Table]:
    """Variants with equally many seeds stand in one table, as in the paper: I the backbones, II the ablations."""
    ordered = sorted(lines, key=lambda line: -line.seeds)
    tables = [Table(seeds, list(group)) for seeds, group in groupby(ordered, key=lambda line: line.seeds)]
    return [table._replace(baseline=_baseline(lines[0], planned, table.seeds)) for table in tables]


def _baseline(first: Line, planned: pd.DataFrame, seeds: int) -> Line | None:
    if first.seeds <= seeds:
        return None
    chosen = first.training_seeds[:seeds]
    own = planned[(planned["variant"] == first.name) & planned["training_seed"].isin(chosen)]
    label = f"{first.label}, first {seeds} seeds" if seeds > 1 else f"{first.label}, first seed"
    return _line(label, own, first.runs[first.runs["training_seed"].isin(chosen)])


def _rate_tests(lines: dict[str, Line], pairs: Pairs, criterion: str) -> list[RateTest]:
    rates = {name: line.runs[f"{criterion}_rate"].to_numpy() for name, line in lines.items()}
    made = [(a, b) for a, b in pairs if a in lines and b in lines]
    mean_holm, spread_holm = (
        holm([test(rates[a], rates[b]) for a, b in made], family=len(pairs)) for test in (mean_p_value, spread_p_value)
    )
    return [
        RateTest(a, b, rates[a].mean() - rates[b].mean(), p_mean, rates[a].std() - rates[b].std(), p_spread)
        for (a, b), p_mean, p_spread in zip(made, mean_holm, spread_holm, strict=True)
    ]


def _correlations(lines: list[Line], ordered: list[Line], criterion: str) -> list[tuple[str, Correlation | None]]:
    def correlate(runs: pd.DataFrame) -> Correlation | None:
        columns = (runs[column].to_numpy() for column in ("heldout_mse_m2", criterion, "variant"))
        return kendall(*columns, np.random.default_rng(0))

    # Two variants of the same checkpoints, evaluated otherwise, would count a seed's error twice.
    different = {
        tuple(line.runs[["training_seed", "heldout_mse_m2"]].itertuples(index=False, name=None)): line
        for line in reversed(lines)
    }
    within = correlate(pd.concat([line.runs for line in lines if line in different.values()]))
    of = {line.name: correlate(line.runs) for line in lines}
    return [("Within variants", within), *((line.label, of[line.name]) for line in ordered)]
