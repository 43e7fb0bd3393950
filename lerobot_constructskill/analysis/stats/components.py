"""What the spread between runs is made of: draws of demonstrations, training seeds on one draw, starts and chance."""

import warnings
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import pandas as pd
from scipy.stats import chi2, t
from statsmodels.regression.mixed_linear_model import MixedLM, MixedLMResults
from statsmodels.tools.sm_exceptions import ConvergenceWarning, SingularMatrixWarning

from lerobot_constructskill.analysis.stats.intervals import Estimate


class Components(NamedTuple):
    """Standard deviations of a run's share of successful episodes, in [0, 1], each with its 95 % interval.

    Args:
        draws: between draws of demonstrations.
        seeds: between training seeds on one draw.
        starts: between lists of as many starts as a run has.
        episodes: what is left: single episodes of one policy from one start, over as many of them.
    """

    draws: Estimate
    seeds: Estimate
    starts: Estimate
    episodes: Estimate


def split(episodes: pd.DataFrame) -> Components | None:
    """Split the spread by a linear mixed model of the episodes, fitted by restricted maximum likelihood.

    A linear model of outcomes that are 0 or 1 gives components in points, which add up; those of a logistic one have
    no such meaning. Intervals are over draws, because outcomes are far from the normal distribution of the model: each
    draw gives an estimate of the other three variances by its own mean squares (Searle et al., Variance Components,
    1992), and these have an interval of Student's t. That of draws is the chi-squared one of the variance of their
    means, less what the other three add to it.

    Args:
        episodes: a row an episode: `draw`, `training_seed`, `evaluation_seed` and whether it succeeded, `met`.

    Returns:
        None where they cannot be told apart: fewer than two draws with two seeds, draws that share starts, or episodes
        that all ended alike, or as their draw, seed or start alone says.
    """
    seeds = episodes.groupby("draw")["training_seed"].nunique()
    shared = episodes.groupby("evaluation_seed")["draw"].nunique().max() > 1 if len(episodes) else False
    if (seeds > 1).sum() < 2 or shared or _is_told_by_one(episodes):
        return None
    told = episodes.astype({"draw": int, "training_seed": int, "evaluation_seed": int, "met": float})
    parts = {"seeds": "0 + C(training_seed)", "starts": "0 + C(evaluation_seed)"}
    model = MixedLM.from_formula("met ~ 1", told, re_formula="1", vc_formula=parts, groups="draw")
    with warnings.catch_warnings():
        for of_a_component_at_0 in (ConvergenceWarning, SingularMatrixWarning, RuntimeWarning):
            warnings.simplefilter("ignore", of_a_component_at_0)  # which its interval says
        try:
            # Other methods stop short where a component is 0, and so does this one where it is not told to go on.
            fit = model.fit(reml=True, method="powell", ftol=1e-10)
        except np.linalg.LinAlgError:  # hardly anything is left beside the components
            return None
        variances = _variances(fit, model.exog_vc.names)
    if not np.isfinite(list(variances.values())).all():
        return None
    a_run = episodes.groupby(["draw", "training_seed"])["evaluation_seed"].nunique().mean()
    for name in ("starts", "episodes"):
        variances[name] /= a_run
    found = intervals([_matrix(own) for _, own in told.groupby("draw")])
    return Components(**{name: _deviation(variances[name], *found[name]) for name in variances})


def _is_told_by_one(episodes: pd.DataFrame) -> bool:
    """Whether nothing is left beside one component: draw, seed or start alone says how each episode ended."""
    parts = ("draw", "training_seed", "evaluation_seed")
    return any(episodes.groupby(part)["met"].nunique().max() == 1 for part in parts)


def _variances(fit: MixedLMResults, parts: list[str]) -> dict[str, float]:
    """The variance of each component, that of starts and episodes over a single one."""
    of_draws = float(np.asarray(fit.cov_re)[0, 0])
    return {"draws": of_draws, **dict(zip(parts, map(float, fit.vcomp), strict=True)), "episodes": float(fit.scale)}


def _matrix(episodes: pd.DataFrame) -> np.ndarray:
    """How the episodes of a draw ended: a row for each training seed, a column for each start that all of them had."""
    return (
        episodes.pivot_table(index="training_seed", columns="evaluation_seed", values="met").dropna(axis=1).to_numpy()
    )


def intervals(draws: Sequence[np.ndarray]) -> dict[str, tuple[float, float]]:
    """The 95 % interval of each component's variance, whose ends may be below 0.

    Args:
        draws: how the episodes of each ended, 0 or 1: a row for each training seed, a column for each start. Two of
            them, at least, have two rows.
    """
    of_each = pd.DataFrame([_mean_squares(met) for met in draws if len(met) > 1])
    half = t.ppf(0.975, len(of_each) - 1) * of_each.sem()
    found = {name: (own.mean() - half[name], own.mean() + half[name]) for name, own in of_each.items()}
    means = of_each.mean().clip(lower=0)
    within = np.mean([means["starts"] + (means["seeds"] + means["episodes"]) / len(met) for met in draws])
    freedom = len(draws) - 1
    total = freedom * np.var([met.mean() for met in draws], ddof=1) / chi2.ppf([0.975, 0.025], freedom)
    return {"draws": tuple(total - within), **found}


def _mean_squares(met: np.ndarray) -> dict[str, float]:
    """The variances of an analysis of variance of one draw, which may be below 0."""
    seeds, starts = met.shape
    of_seeds, of_starts = met.mean(1), met.mean(0)
    rest = np.square(met - of_seeds[:, None] - of_starts + met.mean()).sum() / ((seeds - 1) * (starts - 1))
    return {
        "seeds": of_seeds.var(ddof=1) - rest / starts,
        "starts": (of_starts.var(ddof=1) - rest / seeds) / starts,
        "episodes": rest / starts,
    }


def _deviation(variance: float, low: float, high: float) -> Estimate:
    """The root of a variance and of its interval, which holds it."""
    return Estimate(*(float(np.sqrt(max(one, 0))) for one in (variance, min(low, variance), max(high, variance))))
