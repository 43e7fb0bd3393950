"""A plan and its rows in, everything a report says out, as numbers."""

import json
from itertools import groupby

import numpy as np
import pandas as pd

from lerobot_constructskill.errors import InputError
from lerobot_constructskill.study.plan import StudyPlan
from lerobot_constructskill.study.report.findings import Findings, Line, Outcome, RateTest, SettingFindings, Table
from lerobot_constructskill.study.stats.comparisons import compare, holm
from lerobot_constructskill.study.stats.correlation import Correlation, kendall
from lerobot_constructskill.study.stats.intervals import Estimate, clopper_pearson, wilson
from lerobot_constructskill.study.stats.outcomes import CRITERIA, count, seed_outcomes
from lerobot_constructskill.study.stats.spread import mean_p_value, mean_rate, spread, spread_p_value

REFERENCE_LABELS = {
    "no_op": "No-op",
    "random": "Random actions",
    "replay": "Open-loop replay of one demonstration",
    "blind": "Blind policy (constant image)",
    "untrained": "Same ViT, random weights",
    "expert": "Scripted expert",
}


def collect(plan: StudyPlan, rows: pd.DataFrame) -> Findings:
    """Compute what a report says. The same rows give the same numbers, intervals by resampling included.

    Args:
        plan: the study's plan.
        rows: one line per episode, from `study.rows.read_rows`.

    Raises:
        ValueError: rows belong to another plan, or an episode stands in them twice.
    """
    check_rows(plan, rows)
    runs = _finished(plan, seed_outcomes(rows))
    done = {(run.setting, run.variant, run.training_seed) for run in runs.itertuples()}
    settings = [_setting(plan, name, runs[runs["setting"] == name]) for name in plan.settings]
    return Findings(
        plan=plan,
        settings=settings,
        missing=sum((run.setting, run.variant, run.seed) not in done for run in plan.runs),
        missing_references=[
            (setting.label, REFERENCE_LABELS[name])
            for setting in settings
            for name in plan.references
            if name not in {line.name for line in setting.references}
        ],
        repeated=_repeated(runs),
    )


def check_rows(plan: StudyPlan, rows: pd.DataFrame) -> None:
    """Raise ValueError unless all `rows` are the plan's, each episode once."""
    foreign = rows.loc[rows["plan_sha256"] != plan.sha256, "plan_sha256"]
    if len(foreign):
        raise InputError(
            f"{len(foreign)} of {len(rows)} rows come from another plan ({foreign.iloc[0][:12]}) than plan.yaml "
            f"({plan.sha256[:12]}); report each study from its own folder."
        )
    twice = rows.duplicated(["setting", "variant", "is_reference", "training_seed", "episode"])
    if twice.any():
        row = rows[twice].iloc[0]
        raise InputError(
            f"Episode {row['episode']} of {row['setting']}/{row['variant']}/seed_{row['training_seed']} stands in the "
            "rows twice; every episode must be counted once."
        )


def _finished(plan: StudyPlan, runs: pd.DataFrame) -> pd.DataFrame:
    """Leave out runs of variants that have only some of their episodes: an interrupted study's last one."""
    return runs[runs["is_reference"] | runs["error"].notna() | (runs["episodes"] == plan.episodes)]


def _repeated(runs: pd.DataFrame) -> tuple[int, int]:
    several = runs[runs["episodes"] > 1]
    alike = [several[criterion].isin([0]) | (several[criterion] == several["episodes"]) for criterion in CRITERIA]
    return int((alike[0] & alike[1]).sum()), len(several)


def _setting(plan: StudyPlan, name: str, runs: pd.DataFrame) -> SettingFindings:
    rng = np.random.default_rng(0)
    variants = runs[~runs["is_reference"]]
    lines = [_line(variant, spec.label, spec.seeds, variants, rng) for variant, spec in plan.variants_in(name).items()]
    found = runs[runs["is_reference"]]
    references = [
        _line(reference, REFERENCE_LABELS[reference], None, found, rng)
        for reference in REFERENCE_LABELS
        if (found["variant"] == reference).any()
    ]
    made = {line.name: line for line in lines if line.outcomes}
    pairs = [(a, b) for a, b in plan.pairs if {a, b} <= {line.name for line in lines}]
    comparisons = {
        criterion: compare({n: line.outcomes[criterion].counts for n, line in made.items()}, pairs, plan.alpha)
        for criterion in CRITERIA
    }
    return SettingFindings(
        name=name,
        label=plan.settings[name].label or name,
        lines=lines,
        references=references,
        tables=_tables(lines, rng),
        comparisons=comparisons,
        declared=len(pairs),
        rate_tests={criterion: _rate_tests(made, pairs, criterion, rng) for criterion in CRITERIA},
        correlations={criterion: _correlations(lines, criterion, rng) for criterion in CRITERIA},
    )


def _line(name: str, label: str | None, seeds: int | None, runs: pd.DataFrame, rng: np.random.Generator) -> Line:
    own = runs[runs["variant"] == name]
    finished = own["error"].isna().any()
    by_data = pd.DataFrame([json.loads(errors) for errors in own["heldout_mse_m2_by_data"].dropna()])
    return Line(
        name=name,
        label=label or name,
        seeds=len(own) if seeds is None else seeds,
        runs=own,
        outcomes={criterion: _outcome(own, criterion, rng) for criterion in CRITERIA} if finished else {},
        error=_mean_and_range(own["heldout_mse_m2"]),
        errors_by_data={data: _mean_and_range(by_data[data]) for data in by_data},
    )


def _mean_and_range(errors: pd.Series) -> Estimate | None:
    known = errors.dropna().astype(float)
    return Estimate(*map(float, (known.mean(), known.min(), known.max()))) if len(known) else None


def _outcome(runs: pd.DataFrame, criterion: str, rng: np.random.Generator) -> Outcome:
    counts, rates = count(runs, criterion), runs[f"{criterion}_rate"].to_numpy()
    return Outcome(counts, clopper_pearson(counts), wilson(counts), mean_rate(rates, rng), spread(rates, rng))


def _tables(lines: list[Line], rng: np.random.Generator) -> list[Table]:
    """Variants with equally many seeds stand in one table, as in the paper: I the backbones, II the ablations."""
    ordered = sorted(lines, key=lambda line: -line.seeds)
    tables = [Table(seeds, list(group)) for seeds, group in groupby(ordered, key=lambda line: line.seeds)]
    return [table._replace(baseline=_baseline(lines[0], table.seeds, rng)) for table in tables]


def _baseline(first: Line, seeds: int, rng: np.random.Generator) -> Line | None:
    if first.seeds <= seeds:
        return None
    label = f"{first.label}, first {seeds} seeds"
    return _line(first.name, label, seeds, first.runs[first.runs["training_seed"] < seeds], rng)


def _rate_tests(
    lines: dict[str, Line], pairs: list[tuple[str, str]], criterion: str, rng: np.random.Generator
) -> list[RateTest]:
    rates = {name: line.runs[f"{criterion}_rate"].to_numpy() for name, line in lines.items()}
    made = [(a, b) for a, b in pairs if a in lines and b in lines]
    mean_holm, spread_holm = (
        holm([test(rates[a], rates[b], rng) for a, b in made], family=len(pairs))
        for test in (mean_p_value, spread_p_value)
    )
    return [
        RateTest(a, b, rates[a].mean() - rates[b].mean(), p_mean, rates[a].std() - rates[b].std(), p_spread)
        for (a, b), p_mean, p_spread in zip(made, mean_holm, spread_holm, strict=True)
    ]


def _correlations(lines: list[Line], criterion: str, rng: np.random.Generator) -> list[tuple[str, Correlation | None]]:
    every = pd.concat([line.runs for line in lines])
    runs = [("Within variants", every)] + [(line.label, line.runs) for line in lines]
    columns = "heldout_mse_m2", criterion, "variant"
    return [(label, kendall(*(own[column].to_numpy() for column in columns), rng)) for label, own in runs]
