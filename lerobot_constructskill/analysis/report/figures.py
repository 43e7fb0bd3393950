"""The figures of a report. Each function gives a `Drawing`; none of them computes a result."""

from textwrap import fill

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.colors import LinearSegmentedColormap
from matplotlib.figure import Figure
from matplotlib.patches import Patch, Rectangle

from lerobot_constructskill.analysis.report.findings import Findings, Line, SettingFindings, Sweep
from lerobot_constructskill.analysis.report.ink import (
    ALARM,
    MARKERS,
    MUTED,
    PAPER,
    RAMP,
    RULE,
    SERIES,
    Drawing,
    panels,
)
from lerobot_constructskill.analysis.stats.comparisons import Comparison
from lerobot_constructskill.analysis.stats.outcomes import CRITERIA
from lerobot_constructskill.analysis.stats.power import detectable_difference, wrong_order
from lerobot_constructskill.study.rows import VARIANT

SEEDS = (3, 4, 5, 6, 8, 10, 13, 16, 20, 25, 30, 40, 50)
"""Numbers of seeds on the axes of planning curves."""


def outcome_figure(setting: SettingFindings) -> Drawing:
    """Share of seeds that met each criterion, with floors and ceilings."""
    lines = [line for line in setting.lines if line.outcomes]
    references = [line for line in setting.references if line.outcomes]

    def draw() -> Figure:
        figure, axes = panels(0.9 + 0.32 * (len(lines) + len(references)), sharey=True)
        for axis, criterion in zip(axes, CRITERIA, strict=True):
            for y, line in enumerate(lines):
                _interval(axis, y, line, criterion)
            for y, line in enumerate(references, start=len(lines)):
                share = line.outcomes[criterion].counts.rate
                axis.plot(share, y, "D", color=PAPER, markeredgecolor=MUTED, markersize=6, clip_on=False)
            if references:
                axis.axhline(len(lines) - 0.5, color=RULE, linewidth=0.8)
            axis.set(title=criterion.capitalize(), xlim=(0, 1), xlabel="share of seeds", xticks=np.linspace(0, 1, 5))
            axis.set_xticklabels(["0", "¼", "½", "¾", "1"])
            axis.grid(axis="x", linewidth=0.6)
            axis.set_axisbelow(True)
            axis.spines["left"].set_visible(False)
            axis.tick_params(axis="y", length=0, pad=9)
        axes[0].set_yticks(range(len(lines) + len(references)), [_wrap(line.label) for line in (*lines, *references)])
        axes[0].set_ylim(len(lines) + len(references) - 0.5, -0.6)
        return figure

    caption = "Seeds that met each criterion at least once, with 95 % Clopper–Pearson intervals."
    if references:
        caption += " Diamonds: floors and ceilings."
    return Drawing(f"{setting.name}_outcomes", caption, draw)


def grid_figure(setting: SettingFindings, episodes: int) -> Drawing:
    """The paper's Figure 2a: episodes that met each criterion, one cell a seed."""
    seeds = sorted({seed for line in setting.lines for seed in line.training_seeds})
    stacked = len(seeds) > 12

    def draw() -> Figure:
        rows, columns = (2, 1) if stacked else (1, 2)
        height = rows * (0.75 + 0.3 * len(setting.lines)) + 0.45
        figure, axes = panels(height, rows, columns, sharey=True)
        for axis, criterion in zip(axes, CRITERIA, strict=True):
            _grid(axis, setting.lines, criterion, seeds, episodes)
        for axis in axes[:1] if not stacked else axes:
            axis.set_yticks(range(len(setting.lines)), [_wrap(line.label) for line in setting.lines])
        figure.legend(handles=_cell_key(episodes), loc="outside lower right", ncols=5, fontsize=8)
        return figure

    caption = (
        f"Outcome of every training seed (after the paper's Figure 2a). A cell is one run: its number and its shade "
        f"give the episodes, of {episodes}, that met the criterion; at the right, seeds that met it once or more."
    )
    return Drawing(f"{setting.name}_seeds", caption, draw)


def error_figure(setting: SettingFindings, episodes: int) -> Drawing | None:
    """The paper's Figure 2b: held-out error against episodes that met each criterion. None without any error."""
    lines = [line for line in setting.lines if line.error is not None]
    if not lines:
        return None
    errors = np.concatenate([line.runs["heldout_mse_m2"].dropna() for line in lines])

    def draw() -> Figure:
        figure, axes = panels(3.5 + 0.18 * (len(lines) // 4), sharex=True, sharey=True)
        for axis, criterion in zip(axes, CRITERIA, strict=True):
            for i, line in enumerate(lines):
                # A small step a variant keeps runs apart that share 0 or all episodes.
                offset = 0.03 * episodes * (2 * i / max(1, len(lines) - 1) - 1)
                axis.plot(
                    line.runs["heldout_mse_m2"] * 1e4,
                    line.runs[criterion] + offset,
                    MARKERS[i % len(MARKERS)],
                    color=SERIES[i % len(SERIES)],
                    markeredgecolor=PAPER,
                    markeredgewidth=0.6,
                    markersize=6.5,
                    alpha=0.9,
                    label=_wrap(line.label),
                )
            axis.set(title=criterion.capitalize(), xlabel="held-out translation error (10⁻⁴ m²)")
            axis.grid(axis="y", linewidth=0.6)
            axis.set_axisbelow(True)
        if errors.max() > 10 * errors.min() > 0:
            for axis in axes:
                axis.set_xscale("log")
                axis.xaxis.set_major_formatter("{x:g}")
        axes[0].set_ylabel(f"episodes of {episodes}")
        axes[0].set_ylim(-0.08 * episodes, 1.08 * episodes)
        figure.legend(*axes[0].get_legend_handles_labels(), loc="outside lower center", ncols=4, fontsize=8)
        return figure

    caption = (
        "Held-out error against success, one mark a run (after the paper's Figure 2b). Variants are shifted up or "
        "down a little so that runs with equally many episodes stay apart."
    )
    return Drawing(f"{setting.name}_error", caption, draw)


def ranking_figure(setting: SettingFindings) -> Drawing | None:
    """Chance that a study with so many seeds puts two variants in the wrong order. None where no pair is at risk."""
    pairs = {criterion: _uncertain(setting, criterion) for criterion in CRITERIA}
    if not any(pairs.values()):
        return None

    def draw() -> Figure:
        figure, axes = panels(3.5, sharey=True)
        for axis, criterion in zip(axes, CRITERIA, strict=True):
            for i, pair in enumerate(pairs[criterion]):
                chances = [wrong_order(pair.counts_a.rate, pair.counts_b.rate, seeds) for seeds in SEEDS]
                label = f"{setting.labels[pair.a]} v {setting.labels[pair.b]}"
                colour, marker = SERIES[i % len(SERIES)], MARKERS[i % len(MARKERS)]
                axis.plot(SEEDS, chances, marker=marker, markersize=4, color=colour, label=fill(label, 40))
            _seeds_axis(axis, criterion.capitalize(), "seeds a variant")
            if pairs[criterion]:
                axis.legend(fontsize=7.5, loc="upper right")
            else:
                axis.text(
                    0.5, 0.5, "no observed difference at risk", transform=axis.transAxes, ha="center", color=MUTED
                )
        axes[0].set_ylabel("chance of the wrong order")
        axes[0].set_ylim(0, 0.5)
        axes[0].set_yticks(np.linspace(0, 0.5, 6), [f"{value:.0%}" for value in np.linspace(0, 0.5, 6)])
        return figure

    caption = (
        "By seeds that met the criterion at least once: chance that a study of so many seeds ranks the worse of two "
        "variants first, if the shares observed here were their true ones. Of the declared pairs whose shares differ, "
        "at most the four that are ranked wrongly most often."
    )
    return Drawing(f"{setting.name}_ranking", caption, draw)


def sweep_figure(findings: Findings) -> Drawing:
    """Episodes placed along each sweep: a faint line a seed, a strong one their mean; references in broken grey."""
    sweeps, columns = findings.sweeps, min(4, len(findings.sweeps))
    lines = findings.swept_lines

    def draw() -> Figure:
        rows = -(-len(sweeps) // columns)
        figure, axes = panels(0.5 + 2.4 * rows, rows, columns, sharey=True)
        for axis, sweep in zip(axes, sweeps, strict=False):
            for i, line in enumerate(lines):
                colour = SERIES[i % len(SERIES)] if line.role == VARIANT else MUTED
                _along(axis, sweep, line, colour, MARKERS[i % len(MARKERS)])
            names = [fill(setting.label, 10, break_long_words=False) for setting in sweep.settings]
            axis.set_xticks(range(len(names)), names, fontsize=7.5)
            axis.set(title=sweep.label, xlim=(-0.3, len(names) - 0.7))
            axis.grid(axis="y", linewidth=0.6)
            axis.set_axisbelow(True)
        for axis in axes[len(sweeps) :]:
            axis.set_axis_off()
        for axis in axes[::columns]:
            axis.set_ylabel(f"placed of {findings.episodes}")
        axes[0].set_ylim(-0.06 * findings.episodes, 1.06 * findings.episodes)
        handles = {label: line for axis in axes for line, label in zip(*axis.get_legend_handles_labels(), strict=True)}
        figure.legend(handles.values(), handles, loc="outside lower center", ncols=4, fontsize=8)
        return figure

    caption = (
        "Episodes that were placed, along what is varied, from the left. Faint: one training seed each; strong: their "
        "mean."
    )
    return Drawing("sweeps", caption, draw)


def detectable_figure(findings: Findings) -> Drawing:
    """The smallest difference that a number of seeds shows."""
    rates = (1.0, 0.9, 0.7, 0.5)
    numbers = {line.seeds for setting in findings.settings for line in setting.lines}
    planned = sorted(number for number in numbers if SEEDS[0] <= number <= SEEDS[-1])

    def draw() -> Figure:
        figure, (axis,) = panels(3.5, columns=1)
        for i, rate in enumerate(rates):
            shares = [_worse_share(rate, seeds, findings.alpha) for seeds in SEEDS]
            axis.plot(SEEDS, shares, color=SERIES[i], marker=MARKERS[i], markersize=4)
            axis.annotate(f"better one in {rate:.0%}", (SEEDS[-1], shares[-1]), xytext=(8, 0), va="center",
                          textcoords="offset points", fontsize=8.5, annotation_clip=False)  # fmt: skip
        _seeds_axis(axis, "", "seeds a variant")
        for seeds in planned:
            axis.axvline(seeds, color=MUTED, linewidth=1, linestyle=(0, (4, 3)))
            axis.annotate(f"{seeds} planned", (seeds, 1), xytext=(0, 4), textcoords="offset points", fontsize=8,
                          color=MUTED, ha="center")  # fmt: skip
        axis.set(ylim=(0, 1), ylabel="worse variant succeeds in at most")
        axis.set_yticks(np.linspace(0, 1, 6), [f"{value:.0%}" for value in np.linspace(0, 1, 6)])
        return figure

    caption = (
        "How much worse a variant must be to be told from a better one with 80 % power (Fisher's exact test, one "
        f"comparison at level {findings.alpha:g}). Left of a curve's start not even a variant that never succeeds "
        "shows."
    )
    return Drawing("detectable_difference", caption, draw)


def _along(axis: Axes, sweep: Sweep, of: Line, colour: str, marker: str) -> None:
    """Each seed of a variant or reference, and their mean, over the sweep's settings; where nothing ran is a gap.

    What the study has in one setting alone is no line, and stands in the table. A reference's markers are hollow: what
    reaches it is seen inside.
    """
    lines = sweep.lines(of.label)
    ran = {setting.name: line.runs.set_index("training_seed")["placed"] for setting, line in lines if line.outcomes}
    if not ran or len(lines) < 2:
        return
    seeds = pd.DataFrame(ran).reindex(columns=[setting.name for setting in sweep.settings])
    places = range(len(sweep.settings))
    form = {"linestyle": "-", "markersize": 5}
    if of.role != VARIANT:
        form = {"linestyle": "--", "markersize": 8, "markerfacecolor": "none"}
    for _, placed in seeds.iterrows():
        axis.plot(places, placed, form["linestyle"], marker=".", color=colour, linewidth=0.7, markersize=4, alpha=0.35)
    axis.plot(places, seeds.mean(), marker=marker, color=colour, label=_wrap(of.label), **form)


def _interval(axis: Axes, y: int, line: Line, criterion: str) -> None:
    counts, exact = line.outcomes[criterion].counts, line.outcomes[criterion].exact
    axis.plot([exact.low, exact.high], [y, y], color=SERIES[0], linewidth=3.2, alpha=0.35, solid_capstyle="round")
    axis.plot(exact.value, y, "o", color=SERIES[0], markersize=6.5, clip_on=False)
    axis.annotate(f"{counts.met}/{counts.seeds}", (1, y), xytext=(10, 0), textcoords="offset points", va="center",
                  fontsize=8.5, annotation_clip=False)  # fmt: skip


def _grid(axis: Axes, lines: list[Line], criterion: str, seeds: list[int], episodes: int) -> None:
    ramp = LinearSegmentedColormap.from_list("ramp", RAMP)
    for y, line in enumerate(lines):
        runs = line.runs.set_index("training_seed")
        for seed in line.training_seeds:
            run = runs.loc[seed] if seed in runs.index else None
            _cell(axis, seeds.index(seed), y, run, criterion, episodes, ramp)
        if line.outcomes:
            counts = line.outcomes[criterion].counts
            axis.annotate(f"{counts.met}/{counts.seeds}", (len(seeds) - 0.4, y), va="center", xytext=(3, 0),
                          textcoords="offset points", fontsize=8.5, annotation_clip=False)  # fmt: skip
    axis.set(
        title=criterion.capitalize(), xlim=(-0.5, len(seeds) - 0.5), ylim=(len(lines) - 0.45, -0.55), xlabel="seed"
    )
    step = 1 if len(seeds) <= 40 else 10
    axis.set_xticks(range(0, len(seeds), step), seeds[::step])
    axis.tick_params(length=0, labelsize=8)
    axis.tick_params(axis="y", labelsize=9)
    axis.spines[:].set_visible(False)


def _cell(axis: Axes, x: int, y: int, run, criterion: str, episodes: int, ramp) -> None:
    place = {"xy": (x - 0.45, y - 0.42), "width": 0.9, "height": 0.84}
    if run is None:
        axis.add_patch(Rectangle(**place, fill=False, edgecolor=MUTED, linewidth=0.7, linestyle=(0, (2, 2))))
        return
    if pd.notna(run["error_kind"]):
        axis.add_patch(Rectangle(**place, facecolor=PAPER, edgecolor=ALARM, linewidth=0.8))
        axis.text(x, y, "×", ha="center", va="center", color=ALARM, fontsize=10)
        return
    share = run[criterion] / episodes
    axis.add_patch(Rectangle(**place, facecolor=ramp(share), edgecolor="none"))
    colour = (PAPER if share > 0.55 else "#0c1116") if share else MUTED
    axis.text(x, y, f"{run[criterion]}", ha="center", va="center", color=colour, fontsize=8)


def _cell_key(episodes: int) -> list[Patch]:
    shades = [(RAMP[0], "no episode"), (RAMP[1], "half"), (RAMP[2], f"all {episodes}")]
    return [
        *(Patch(facecolor=colour, label=label) for colour, label in shades),
        Patch(facecolor=PAPER, edgecolor=ALARM, label="× run failed"),
        Patch(facecolor=PAPER, edgecolor=MUTED, linewidth=0.7, linestyle=(0, (2, 2)), label="not run yet"),
    ]


def _worse_share(rate: float, seeds: int, alpha: float) -> float:
    drop = detectable_difference(rate, seeds, alpha)
    return np.nan if drop is None else rate - drop


def _uncertain(setting: SettingFindings, criterion: str, most: int = 4) -> list[Comparison]:
    """The pairs that three seeds rank wrongly most often, where that happens at all."""
    chances = {
        pair: wrong_order(pair.counts_a.rate, pair.counts_b.rate, SEEDS[0])
        for pair in setting.comparisons[criterion]
        if pair.counts_a.rate != pair.counts_b.rate
    }
    return sorted((pair for pair in chances if chances[pair] >= 0.01), key=chances.get, reverse=True)[:most]


def _seeds_axis(axis: Axes, title: str, label: str) -> None:
    axis.set_xscale("log")
    axis.set_xticks([3, 5, 10, 20, 30, 50], ["3", "5", "10", "20", "30", "50"])
    axis.set_xticks([], minor=True)
    axis.set(title=title, xlabel=label, xlim=(2.75, 54))
    axis.grid(linewidth=0.6)
    axis.set_axisbelow(True)


def _wrap(label: str) -> str:
    return fill(label, 24)
