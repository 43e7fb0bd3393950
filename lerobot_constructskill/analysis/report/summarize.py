"""Computes all numbers of a report from the rows of a study and its analysis section."""

import json
from itertools import combinations, groupby

import numpy as np
import pandas as pd

from lerobot_constructskill.analysis.report.findings import (
    Findings,
    SeedGroup,
    SettingFindings,
    Success,
    Sweep,
    VariantFindings,
)
from lerobot_constructskill.analysis.section import Analysis
from lerobot_constructskill.analysis.stats.comparisons import compare
from lerobot_constructskill.analysis.stats.components import Components, split
from lerobot_constructskill.analysis.stats.correlation import Correlation, kendall
from lerobot_constructskill.analysis.stats.intervals import Estimate, clopper_pearson, mean_rate
from lerobot_constructskill.analysis.stats.outcomes import CRITERIA, RUN, by_unit, chance_of, count, runs_of
from lerobot_constructskill.analysis.stats.walls import wall_of
from lerobot_constructskill.errors import InputError
from lerobot_constructskill.study.rows import NOT_RUN, VARIANT, Draws


def summarize(analysis: Analysis, rows: pd.DataFrame, draws: Draws) -> Findings:
    """Compute what a report says. The same rows give the same numbers, including resampled intervals.

    Args:
        analysis: how to read the rows.
        rows: one row per episode, from `study.rows.read_rows`.
        draws: which training seeds share demonstrations.

    Raises:
        InputError: there are no rows, they contradict each other, or `analysis` names something unknown.
    """
    check_rows(rows)
    rows = rows.assign(draw=rows["training_seed"].map(draws.of))
    planned, runs = rows.drop_duplicates(RUN), runs_of(rows)
    seeds = runs["training_seed"]
    runs = runs.assign(draw=seeds.map(draws.of), unit=seeds.map(draws.unit))
    of_variants = planned["role"] == VARIANT
    variants, references = (planned.loc[chosen, "variant"].unique() for chosen in (of_variants, ~of_variants))
    analysis.check(variants, planned["setting"].unique(), references)
    settings = {
        name: _setting(analysis, name, own, runs[runs["setting"] == name], rows[rows["setting"] == name])
        for name, own in planned.groupby("setting", sort=False)
    }
    return Findings(
        settings=list(settings.values()),
        means=[_mean(analysis, name, own, planned, runs, rows) for name, own in analysis.means.items()],
        sweeps=[
            Sweep(analysis.label(name), [settings[one] for one in swept]) for name, swept in analysis.sweeps.items()
        ],
        alpha=analysis.alpha,
        episodes=int(rows["episodes"].iloc[0]),
        first_seed=int(rows["evaluation_seed"].min()),
        last_seed=int((rows["evaluation_seed"] - rows["episode"] + rows["episodes"] - 1).max()),
        planned=int(of_variants.sum()),
        planned_references=int((~of_variants).sum()),
        missing=int((planned["error_kind"] == NOT_RUN).sum()),
    )


def check_rows(rows: pd.DataFrame) -> None:
    """Check that rows can be summarized.

    Raises:
        InputError: there are no rows, a setting has no variant, runs differ in their number of episodes, an episode
            of a finished run lacks its outcome, or an episode stands in the rows twice.
    """
    if rows.empty:
        raise InputError("The study's table has no rows.")
    if bare := set(rows["setting"]) - set(rows.loc[rows["role"] == VARIANT, "setting"]):
        raise InputError(f"Setting '{min(bare)}' has no variant to report.")
    if len(lengths := sorted(rows["episodes"].unique())) > 1:
        raise InputError(f"One table has runs of {lengths[0]} and of {lengths[1]} episodes; report them separately.")
    finished = rows[rows["error_kind"].isna()]
    if bare := [name for name in CRITERIA if finished[name].isna().any()]:
        raise InputError(f"Whether an episode of a run that finished was {bare[0]} is missing in its row.")
    twice = rows[rows.duplicated([*RUN, "episode"])]
    if len(twice):
        setting, variant, seed, episode = twice[[*RUN, "episode"]].iloc[0]
        raise InputError(
            f"Episode {episode} of {setting}/{variant}/seed_{seed} is in the rows twice; it must be counted once."
        )


def _mean(
    analysis: Analysis, name: str, settings: list[str], planned: pd.DataFrame, runs: pd.DataFrame, rows: pd.DataFrame
) -> SettingFindings:
    """The mean over some settings: each seed's share is the mean of its shares, whatever number of episodes they have.

    A seed that did not run in all of the settings is planned and not made.
    """
    own = runs[runs["setting"].isin(settings)].groupby(["variant", "training_seed"], as_index=False)
    shares = [f"{criterion}_rate" for criterion in CRITERIA]
    means = own.first().drop(columns=[*shares, "heldout_mse_m2", "heldout_mse_m2_by_data"])
    means = means.merge(own[[*shares, "heldout_mse_m2"]].mean()).assign(setting=name, heldout_mse_m2_by_data=None)
    whole = means[(own.size()["size"] == len(settings)).to_numpy()]
    seeds = planned[planned["setting"].isin(settings)].drop_duplicates(["variant", "training_seed"])
    episodes = rows[rows["setting"].isin(settings)].merge(whole[["variant", "training_seed"]])
    return _setting(analysis, name, seeds.assign(setting=name), whole, episodes, is_mean=True)


def _setting(
    analysis: Analysis,
    name: str,
    planned: pd.DataFrame,
    runs: pd.DataFrame,
    episodes: pd.DataFrame,
    is_mean: bool = False,
) -> SettingFindings:
    """One setting. Only the tables follow `analysis.order`, so that another order shows the same numbers."""
    of_variants = planned["role"] == VARIANT
    variants, references = (
        _variants(analysis, planned[chosen], runs, episodes, is_mean) for chosen in (of_variants, ~of_variants)
    )
    ordered = sorted(variants, key=lambda one: analysis.rank(one.name))
    pairs = analysis.comparisons
    if pairs is None:
        pairs = [(a.name, b.name) for a, b in combinations(variants, 2) if a.seeds == b.seeds]
    pairs = [(a, b) for a, b in pairs if {a, b} <= {one.name for one in variants}]
    made = [one for one in variants if one.success]
    comparisons = {
        criterion: compare({one.name: _rates(one.runs, criterion) for one in made}, pairs, analysis.alpha)
        for criterion in CRITERIA
    }
    return SettingFindings(
        name=name,
        label=analysis.label(name),
        variants=ordered,
        references=references,
        data_sets=_data_sets(runs),
        groups=_groups(ordered, planned),
        declared=len(pairs),
        comparisons=comparisons,
        correlations=_correlations(variants, ordered),
    )


def _variants(
    analysis: Analysis, planned: pd.DataFrame, runs: pd.DataFrame, episodes: pd.DataFrame, is_mean: bool
) -> list[VariantFindings]:
    return [
        _variant(
            analysis.label(name), own, runs[runs["variant"] == name], episodes[episodes["variant"] == name], is_mean
        )
        for name, own in planned.groupby("variant", sort=False)
    ]


def _variant(
    label: str,
    planned: pd.DataFrame,
    runs: pd.DataFrame,
    episodes: pd.DataFrame | None = None,
    is_mean: bool = False,
) -> VariantFindings:
    finished = runs["error_kind"].isna().any()
    of_task = None if is_mean else episodes
    by_data = pd.DataFrame([json.loads(errors) for errors in runs["heldout_mse_m2_by_data"].dropna()])
    return VariantFindings(
        name=planned["variant"].iloc[0],
        label=label,
        demonstrations=next(iter(planned["demonstrations"].dropna()), None),
        training_seeds=tuple(sorted(planned["training_seed"])),
        runs=runs,
        success={criterion: _success(runs, episodes, criterion) for criterion in CRITERIA} if finished else {},
        error=_mean_and_range(runs["heldout_mse_m2"]),
        errors_by_data={data: _mean_and_range(by_data[data]) for data in by_data},
        components=None if of_task is None else _components(of_task),
        wall=None if of_task is None else wall_of(of_task),
    )


def _components(episodes: pd.DataFrame) -> Components | None:
    return split(episodes[episodes["error_kind"].isna()].rename(columns={"placed": "met"}))


def _mean_and_range(errors: pd.Series) -> Estimate | None:
    known = errors.dropna()
    return Estimate(float(known.mean()), float(known.min()), float(known.max())) if len(known) else None


def _success(runs: pd.DataFrame, episodes: pd.DataFrame | None, criterion: str) -> Success:
    rates = _rates(runs, criterion)
    counts = count(rates)
    has_chance = episodes is not None and not runs["unit"].duplicated().any()
    chance = chance_of(episodes, criterion) if has_chance else None
    return Success(counts, clopper_pearson(counts), mean_rate(rates), float(rates.min()), float(rates.std()), chance)


def _rates(runs: pd.DataFrame, criterion: str) -> np.ndarray:
    """The share of each seed or, where each draw has demonstrations of its own, of each draw."""
    return by_unit(runs[f"{criterion}_rate"], runs["unit"])


def _data_sets(runs: pd.DataFrame) -> list[str]:
    """The setting's own data set, to which `heldout_mse_m2` belongs, then the others."""
    known = runs.dropna(subset="heldout_mse_m2_by_data")
    errors = list(zip(known["heldout_mse_m2_by_data"].map(json.loads), known["heldout_mse_m2"], strict=True))
    names = dict.fromkeys(name for by_data, _ in errors for name in by_data)
    return sorted(names, key=lambda name: not any(by_data.get(name) == own for by_data, own in errors))


def _groups(variants: list[VariantFindings], planned: pd.DataFrame) -> list[SeedGroup]:
    """Variants by number of seeds, as in the paper: table I has the backbones, table II the ablations."""
    first, ordered = variants[0], sorted(variants, key=lambda one: -one.seeds)
    return [
        SeedGroup(seeds, list(group), _first_seeds(first, planned, seeds) if first.seeds > seeds else None)
        for seeds, group in groupby(ordered, key=lambda one: one.seeds)
    ]


def _first_seeds(variant: VariantFindings, planned: pd.DataFrame, seeds: int) -> VariantFindings:
    chosen = variant.training_seeds[:seeds]
    own = planned[(planned["variant"] == variant.name) & planned["training_seed"].isin(chosen)]
    label = f"{variant.label}, first {f'{seeds} seeds' if seeds > 1 else 'seed'}"
    return _variant(label, own, variant.runs[variant.runs["training_seed"].isin(chosen)])


def _correlations(
    variants: list[VariantFindings], ordered: list[VariantFindings]
) -> list[tuple[str, dict[str, Correlation | None]]]:
    def correlate(runs: pd.DataFrame) -> dict[str, Correlation | None]:
        columns = ["heldout_mse_m2", *(f"{name}_rate" for name in CRITERIA)]
        units = runs.groupby(["variant", "unit"], sort=False)[columns].mean().reset_index()
        error, *rates = (units[column].to_numpy() for column in columns)
        variant = units["variant"].to_numpy()
        found = (kendall(error, of, variant, np.random.default_rng(0)) for of in rates)
        return dict(zip(CRITERIA, found, strict=True))

    # Two variants of the same checkpoints, evaluated differently, would count a seed's error twice.
    different = {
        tuple(one.runs[["training_seed", "heldout_mse_m2"]].itertuples(index=False, name=None)): one
        for one in reversed(variants)
    }
    within = pd.concat([one.runs for one in variants if one in different.values()])
    return [("all, within variants", correlate(within)), *((one.label, correlate(one.runs)) for one in ordered)]
