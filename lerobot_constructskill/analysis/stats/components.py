"""What the spread between runs is made of: draws of demonstrations, training seeds on one draw, starts and chance."""

import warnings
from typing import NamedTuple

import numpy as np
import pandas as pd
from scipy.stats import chi2
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
    no such meaning. The intervals are Satterthwaite's (Biometrics Bulletin 2, 1946): chi-squared, with the degrees of
    freedom that the standard error of a variance stands for. They are wide over few draws, and 0 to infinity where a
    component is estimated as 0 or so near to it that they do not hold.

    Args:
        episodes: a row an episode: `draw`, `training_seed`, `evaluation_seed` and whether it succeeded, `met`.

    Returns:
        None where they cannot be told apart: fewer than two draws, no draw with two seeds, draws that share starts, or
        episodes that all ended alike, or as their draw, seed or start alone says.
    """
    seeds = episodes.groupby("draw")["training_seed"].nunique()
    shared = episodes.groupby("evaluation_seed")["draw"].nunique().max() > 1 if len(episodes) else False
    if len(seeds) < 2 or seeds.max() < 2 or shared or _is_told_by_one(episodes):
        return None
    told = episodes.astype({"draw": int, "training_seed": int, "evaluation_seed": int, "met": float})
    parts = {"seeds": "0 + C(training_seed)", "starts": "0 + C(evaluation_seed)"}
    model = MixedLM.from_formula("met ~ 1", told, re_formula="1", vc_formula=parts, groups="draw")
    with warnings.catch_warnings():
        for of_a_component_at_0 in (ConvergenceWarning, SingularMatrixWarning, RuntimeWarning):
            warnings.simplefilter("ignore", of_a_component_at_0)  # which its interval says
        try:
            fit = model.fit(reml=True, method="powell")  # others stop short where a component is 0
        except np.linalg.LinAlgError:  # hardly anything is left beside the components
            return None
        found = _deviations(fit, model.exog_vc.names)
    if not np.isfinite([one.value for one in found.values()]).all():
        return None
    found["episodes"] = _deviation(fit.scale, fit.scale * np.sqrt(2 / len(episodes)))
    a_run = np.sqrt(episodes.groupby(["draw", "training_seed"])["evaluation_seed"].nunique().mean())
    for name in ("starts", "episodes"):
        found[name] = Estimate(*(float(value / a_run) for value in found[name]))
    return Components(**found)


def _is_told_by_one(episodes: pd.DataFrame) -> bool:
    """Whether nothing is left beside one component: draw, seed or start alone says how each episode ended."""
    parts = ("draw", "training_seed", "evaluation_seed")
    return any(episodes.groupby(part)["met"].nunique().max() == 1 for part in parts)


def _deviations(fit: MixedLMResults, parts: list[str]) -> dict[str, Estimate]:
    """The standard deviation of each component and its interval."""
    variances = {"draws": float(np.asarray(fit.cov_re)[0, 0]), **dict(zip(parts, map(float, fit.vcomp), strict=True))}
    errors = dict(zip(variances, fit.bse.iloc[-len(variances) :], strict=True))
    return {name: _deviation(variance, errors[name] * fit.scale) for name, variance in variances.items()}


def _deviation(variance: float, error: float) -> Estimate:
    """The root of a variance with this standard error, and its interval."""
    value = float(np.sqrt(max(variance, 0)))
    if variance > 0 and np.isfinite(error):
        freedom = 2 * (variance / error) ** 2
        with np.errstate(divide="ignore"):  # next to no degree of freedom
            low, high = value * np.sqrt(freedom / chi2.ppf([0.975, 0.025], freedom))
        if low <= value:
            return Estimate(value, float(low), float(high))
    return Estimate(value, 0.0, float("inf"))
