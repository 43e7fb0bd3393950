"""The figures of a report."""

import io
import warnings
from itertools import cycle
from pathlib import Path
from textwrap import fill

import matplotlib
import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.colors import LinearSegmentedColormap
from matplotlib.figure import Figure
from PIL import Image

from lerobot_constructskill.analysis.report.findings import Findings, SettingFindings, Sweep
from lerobot_constructskill.analysis.stats.outcomes import CRITERIA
from lerobot_constructskill.artifacts.folders import replaced

STYLE = Path(__file__).parent / "templates" / "report.mplstyle"

RAMP = LinearSegmentedColormap.from_list("episodes", ["#eef1f4", "#9fc3e0", "#1d5b94"])
"""Colours from no episode to all episodes."""

ALARM, MUTED = "#b8400a", "#667078"
"""Colours of failed runs and of references."""

WIDTH = 9.2
"""Width of every figure in inches."""

MOST_BESIDE = 12
"""Number of training seeds up to which the two criteria stand side by side."""

SHADES = 64
"""Number of colours in a PNG, which makes it a third as large and looks the same."""


def write_figures(findings: Findings, folder: Path) -> None:
    """Write the figures as PNG.

    They are `seeds`, `sweeps`, and `<setting>_error` and `<setting>_draws` of settings with held-out errors or draws.
    """
    folder.mkdir(exist_ok=True)
    with matplotlib.rc_context(fname=STYLE), warnings.catch_warnings():
        warnings.filterwarnings("ignore", message="Glyph .* missing")  # a label may be in any script
        save(seeds_figure(findings), folder / "seeds.png")
        for setting in findings.sections:
            if setting.validated:
                save(error_figure(setting, findings.episodes), folder / f"{setting.name}_error.png")
            if setting.drawn:
                save(draws_figure(setting, findings.episodes), folder / f"{setting.name}_draws.png")
        if findings.sweeps:
            save(sweeps_figure(findings), folder / "sweeps.png")


def save(figure: Figure, path: Path) -> None:
    """Write a figure as a PNG of few colours, which has the same bytes at every call."""
    drawn = io.BytesIO()
    figure.savefig(drawn)
    with replaced(path) as partial:
        Image.open(drawn).convert("RGB").quantize(SHADES).save(partial, format="png", optimize=True)


def seeds_figure(findings: Findings) -> Figure:
    """The paper's Figure 2a: episodes of a run that met each criterion, one cell a training seed.

    Settings of which nothing was made yet are left out, unless that is all of them.
    """
    made = [one for one in findings.sections if any(len(own.runs) for own in one.variants)]
    sections = made or findings.sections
    stacked = {setting.name: len(_seeds_of(setting)) > MOST_BESIDE for setting in sections}
    titles = {
        one.name: [fill(f"{one.label}: {criterion}", 44 * (1 + stacked[one.name])) for criterion in CRITERIA]
        if len(findings.sections) > 1
        else [criterion.capitalize() for criterion in CRITERIA]
        for one in sections
    }
    heights = [
        (1 + stacked[one.name]) * (0.75 + 0.3 * len(one.variants) + 0.15 * titles[one.name][0].count("\n")) + 0.2
        for one in sections
    ]
    figure = Figure(figsize=(WIDTH, sum(heights)), layout="constrained")
    parts = figure.subfigures(len(sections), 1, squeeze=False, height_ratios=heights)[:, 0]
    for part, setting in zip(parts, sections, strict=True):
        rows, columns = (2, 1) if stacked[setting.name] else (1, 2)
        axes = part.subplots(rows, columns, sharey=True)
        for axis, criterion, title in zip(axes, CRITERIA, titles[setting.name], strict=True):
            _draw_seeds(axis, setting, criterion, findings.episodes)
            axis.set(title=title)
        axes[0].set_yticks(np.arange(len(setting.variants)) + 0.5, [fill(one.label, 24) for one in setting.variants])
        axes[0].invert_yaxis()
    return figure


def error_figure(setting: SettingFindings, episodes: int) -> Figure:
    """The paper's Figure 2b: held-out error of each run against its episodes that met each criterion."""
    variants = setting.validated
    figure, axes = _panels(3.5 + 0.18 * (len(variants) // 4), sharex=True, sharey=True)
    for axis, criterion in zip(axes, CRITERIA, strict=True):
        for one, shift in zip(variants, np.linspace(-0.03, 0.03, len(variants)), strict=True):
            shifted = one.runs[criterion] + shift * episodes  # keeps runs apart that have 0 or all episodes
            form = {"linestyle": "none", "markeredgecolor": "white", "markeredgewidth": 0.6}
            axis.plot(one.runs["heldout_mse_m2"] * 1e4, shifted, label=fill(one.label, 24), **form)
        axis.set(title=criterion.capitalize(), xlabel="held-out translation error (10⁻⁴ m²)")
    if max(one.error.high for one in variants) > 10 * min(one.error.low for one in variants) > 0:
        axes[0].set_xscale("log")
        axes[0].xaxis.set_major_formatter("{x:g}")
    axes[0].set(ylabel=f"episodes of {episodes}", ylim=(-0.08 * episodes, 1.08 * episodes))
    figure.legend(*axes[0].get_legend_handles_labels(), loc="outside lower center", ncols=4)
    return figure


def draws_figure(setting: SettingFindings, episodes: int) -> Figure:
    """Episodes of each run that placed, by draw of demonstrations: a mark a training seed, a bar their mean."""
    figure, axes = _panels(2.6, 1, len(setting.drawn), sharey=True)
    for axis, one in zip(axes, setting.drawn, strict=True):
        by_draw = {draw: runs["placed"] for draw, runs in one.runs.groupby("draw")}
        for number, placed in enumerate(by_draw.values()):
            axis.hlines(placed.mean(), number - 0.3, number + 0.3, color=MUTED)
            beside = number + np.linspace(-0.15, 0.15, len(placed)) * (len(placed) > 1)
            axis.plot(beside, placed, "o", color="#1d5b94", markeredgecolor="white")
        axis.set_xticks(range(len(by_draw)), [*by_draw])
        axis.set(title=fill(one.label, 40), xlabel="draw of demonstrations")
    axes[0].set(ylabel=f"placed of {episodes}", ylim=(-0.06 * episodes, 1.06 * episodes))
    return figure


def sweeps_figure(findings: Findings) -> Figure:
    """Episodes placed along each sweep: a faint line a seed, a strong line their mean; references are grey."""
    sweeps, columns = findings.sweeps, min(4, len(findings.sweeps))
    rows = -(-len(sweeps) // columns)
    figure, axes = _panels(0.5 + 2.4 * rows, rows, columns, sharey=True)
    for axis, sweep in zip(axes, sweeps, strict=False):
        for label, style in zip(findings.swept_labels, cycle(matplotlib.rcParams["axes.prop_cycle"]), strict=False):
            _draw_along(axis, sweep, label, style)
        names = [fill(setting.label, 10, break_long_words=False) for setting in sweep.settings]
        axis.set_xticks(range(len(names)), names, fontsize=7.5)
        axis.set(title=sweep.label, xlim=(-0.3, len(names) - 0.7))
    for axis in axes[len(sweeps) :]:
        axis.set_axis_off()
    axes[0].set(ylabel=f"placed of {findings.episodes}", ylim=(-0.06 * findings.episodes, 1.06 * findings.episodes))
    handles = {label: line for axis in axes for line, label in zip(*axis.get_legend_handles_labels(), strict=True)}
    figure.legend(handles.values(), handles, loc="outside lower center", ncols=4)
    return figure


def _panels(height: float, rows: int = 1, columns: int = 2, **shared) -> tuple[Figure, list[Axes]]:
    """A figure of `height` inches and its axes in reading order."""
    figure = Figure(figsize=(WIDTH, height), layout="constrained")
    return figure, list(figure.subplots(rows, columns, squeeze=False, **shared).flat)


def _seeds_of(setting: SettingFindings) -> list[int]:
    return sorted({seed for one in setting.variants for seed in one.training_seeds})


def _draw_seeds(axis: Axes, setting: SettingFindings, criterion: str, episodes: int) -> None:
    """Draw a row of cells for each variant, and to its right in how many seeds the criterion was met."""
    seeds = _seeds_of(setting)
    by_variant = {one.name: one.runs.set_index("training_seed")[criterion] for one in setting.variants}
    cells = pd.DataFrame(by_variant, index=seeds).T.to_numpy(float)
    axis.pcolormesh(cells, cmap=RAMP, vmin=0, vmax=episodes, edgecolors="white", linewidth=2)
    for y, one in enumerate(setting.variants):
        for seed in one.training_seeds:
            x = seeds.index(seed)
            text, colour = _cell(cells[y, x], seed in set(one.failures["training_seed"]), episodes)
            axis.text(x + 0.5, y + 0.5, text, color=colour, ha="center", va="center", fontsize=8)
        if one.success:
            met = "{}/{}".format(*one.success[criterion].counts)
            axis.text(len(seeds) + 0.1, y + 0.5, met, va="center", fontsize=8.5)
    step = 1 if len(seeds) <= 40 else 10
    axis.set_xticks(np.arange(0, len(seeds), step) + 0.5, seeds[::step])
    axis.set(xlabel="training seed")
    axis.grid(visible=False)
    axis.tick_params(length=0)
    axis.spines[:].set_visible(False)


def _cell(met: float, failed: bool, episodes: int) -> tuple[str, str]:
    """Text and colour of one run's cell; `met` is NaN if the run was not made."""
    if failed or np.isnan(met):
        return ("×", ALARM) if failed else ("–", MUTED)
    return f"{met:.0f}", "white" if met > 0.55 * episodes else "black"


def _draw_along(axis: Axes, sweep: Sweep, label: str, style: dict[str, str]) -> None:
    """Draw each seed of a variant or reference and their mean over the settings; a setting without a run is a gap."""
    found = sweep.find(label)
    ran = {setting.name: one.runs.set_index("training_seed")["placed"] for setting, one in found if one.success}
    if not ran or len(found) < 2:
        return  # of one setting alone there is no line; the table holds it
    seeds = pd.DataFrame(ran, columns=[setting.name for setting in sweep.settings], dtype=float)
    if any(one in setting.references for setting, one in found):
        style = {**style, "color": MUTED, "linestyle": "--", "markerfacecolor": "none", "markersize": 8}
    axis.plot(seeds.T.to_numpy(), **style | {"marker": ".", "linewidth": 0.7, "markersize": 4, "alpha": 0.35})
    axis.plot(seeds.mean().to_numpy(), **style, label=fill(label, 24))
