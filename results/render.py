"""Writes the numbers of result tables in pages from the rows of studies: `python results/render.py`.

A row of a table with a link to a report, whose title names an arm (setting/variant), has its numbers from there, each
column by its head (`HEADS`). A link whose title begins with one of `WORDS` has that number as its text:

    | finer maps | 489/500 | 68 to 99 | [precise](results/precise/report.md "brick_to_bin_shifted/precise") |
    | `light` | [500](report.md "placed light_1/precise") | [500](report.md "placed light_2/precise") |

The name of one of the study's `means` may stand in place of a setting: each seed that ran in all of its settings is
then counted once, with the episodes of all of them. A draw counts once all of its seeds are there.
"""

import json
import re
import sys
from collections import Counter
from collections.abc import Callable, Iterator
from functools import cache
from itertools import chain, repeat
from pathlib import Path
from statistics import median

import numpy as np
import pandas as pd

from lerobot_constructskill.analysis.report.formats import in_points, percent
from lerobot_constructskill.analysis.stats.intervals import Estimate, clopper_pearson, mean_rate
from lerobot_constructskill.analysis.stats.outcomes import CRITERIA, by_unit, chance_of, count, runs_of
from lerobot_constructskill.study.rows import ROWS, Draws, read_draws, read_environments, read_means, read_rows
from lerobot_constructskill.study.timing import STAGES, entries, seconds_of_one

ROOT = Path(__file__).parents[1]

PAGES = [
    ROOT / "README.md",
    *(ROOT / "docs" / name for name in ("policies.md", "results.md", "tasks.md")),
    *sorted((ROOT / "results").glob("*/notes.md")),
]

OFTEN = ["", "", " (two)", " (three)", " (four)", " (five)", " (six)", " (seven)", " (eight)", " (nine)", " (ten)"]
"""How often a number stands in a list; above, in digits."""


NOT_YET = "not run yet"


class Arm:
    """What the rows of a study say of one variant in one setting, or in all settings of a mean.

    Args:
        folder: of the study.
        rows: of the study.
        draws: of its demonstrations and starts.
        means: its settings by the name of their mean.
        name: setting/variant, or mean/variant.

    Raises:
        SystemExit: the study has no such arm.
    """

    def __init__(self, folder: Path, rows: pd.DataFrame, draws: Draws, means: dict[str, list[str]], name: str):
        setting, variant = name.split("/")
        settings = means.get(setting, [setting])
        self._times = [one for one in entries(folder) if one["arm"] in {f"{own}/{variant}" for own in settings}]
        own = rows[rows["setting"].isin(settings) & (rows["variant"] == variant)]
        if {*own["setting"]} != {*settings}:
            raise SystemExit(f"A page names {name}, which its study does not have.")
        runs = runs_of(own)
        planned = own.groupby(["setting", "training_seed"])["episodes"].first()  # a failed run did none of them
        runs["episodes"] = [planned[key] for key in zip(runs["setting"], runs["training_seed"], strict=True)]
        runs = _over(runs, len(settings))
        units = runs["training_seed"].map(draws.unit)
        whole = units.map(units.value_counts()) == (draws.seeds_a_draw if draws.groups_seeds else 1)
        self.runs = runs[whole].reset_index(drop=True)
        self.rows = own[own["training_seed"].isin(self.runs["training_seed"])]
        self.draws, self.units = (self.runs["training_seed"].map(of) for of in (draws.of, draws.unit))

    def met(self, criterion: str) -> str:
        """Its episodes that did, of all; one of a failed seed did not."""
        return f"{self.runs[criterion].sum()}/{self.runs['episodes'].sum()}"

    def rates(self, criterion: str) -> np.ndarray:
        """The share of each seed or, where several share a draw, of each draw."""
        return by_unit(self.runs[f"{criterion}_rate"], self.units)

    def seeds(self, criterion: str) -> str:
        counts = count(self.rates(criterion))
        return f"{counts.met}/{counts.seeds}{'' if self.units.is_unique else ' draws'}"

    def seeds_with_interval(self) -> str:
        counts = count(self.rates("placed"))
        return f"{counts.met}/{counts.seeds} ({_range(clopper_pearson(counts))} %)"

    @property
    def mean(self) -> Estimate:
        return mean_rate(self.rates("placed"))

    def episodes(self) -> str:
        return f"{self.met('placed')}: {percent(self.mean.value)} ({_range(self.mean)})"

    def worst(self) -> str:
        return f"{self.rates('placed').min() * self.runs['episodes'].max():g}"

    def spread(self) -> str:
        if len(self.rates("placed")) < 2:
            return "–"
        chance = chance_of(self.rows, "placed") if self.units.is_unique else None
        return f"{in_points(self.runs['placed_rate'].std(ddof=0))}, {in_points(chance)}"

    def each(self) -> str:
        often = Counter(sorted(self.runs["placed"]))
        return ", ".join(
            f"{placed}{OFTEN[times] if times < len(OFTEN) else f' ({times})'}" for placed, times in often.items()
        )

    def in_order(self) -> str:
        return ", ".join(map(str, self.runs["placed"]))

    def error(self) -> str:
        errors = 1e4 * self.runs["heldout_mse_m2"].dropna()
        return f"{errors.mean():.2f} [{errors.min():.2f} to {errors.max():.2f}]" if len(errors) else "–"

    def minutes(self) -> str:
        """How long one set of demonstrations took, its features, and the training of one seed."""

        def of(stage: str) -> str:
            took = [seconds_of_one(one) for one in self._times if one["stage"] == stage]
            return f"{median(took) / 60:.0f}" if took else "–"

        return ", ".join(map(of, STAGES[:3])) if self._times else "–"

    def cpu(self) -> str:
        told = {json.loads(versions).get("processor") or "not recorded" for versions in self.rows["versions"].dropna()}
        return " and ".join(sorted(set(map(make_of, told))))


def make_of(processor: str) -> str:
    """The make of a processor: its name without family and model."""
    return re.sub(r"\(R\)| Processor| \(.*", "", processor)


WORDS: dict[str, Callable[[Arm], str]] = {
    "placed": lambda arm: arm.met("placed"),
    "count": lambda arm: arm.met("placed").split("/")[0],
    "each": Arm.in_order,
    "spread": Arm.spread,
    "worst": Arm.worst,
    "draws": lambda arm: str(arm.draws.nunique()),
}
"""Of links."""

LINK = re.compile(
    rf'\[(?P<text>[^\]]*)\]\((?P<file>[^ )]*report\.md) "(?:(?P<word>{"|".join(WORDS)}) )?(?P<arm>[^"/]+/\w+)"\)'
)

HEADS: dict[str, Callable[[Arm], str]] = {
    "placed": lambda arm: arm.met("placed"),
    "placed, each on a draw of its own": lambda arm: arm.met("placed"),
    "lifted": lambda arm: arm.met("lifted"),
    "interval, %": lambda arm: _range(arm.mean),
    "spread, by chance": Arm.spread,
    "episodes placed (mean over seeds, 95 % interval)": Arm.episodes,
    "seeds that placed": lambda arm: arm.seeds("placed"),
    "seeds that lifted": lambda arm: arm.seeds("lifted"),
    "seeds that placed (interval)": Arm.seeds_with_interval,
    "each seed": Arm.each,
    "held-out error, 1e-4 m2": Arm.error,
    "CPU": Arm.cpu,
    "minutes": Arm.minutes,
}
"""Of columns."""


def render(page: Path, text: str | None = None) -> str:
    """A page with the numbers that the rows have now.

    Args:
        page: the file.
        text: of the page, if not as it lies there.

    Raises:
        SystemExit: a link names a study, or an arm of one, that there is not.
    """
    return "".join(f"{line}\n" for line, _, _ in _lines(page, text))


def literals(page: Path) -> list[str]:
    """The lines of result tables with numbers that come from no rows, except for those of the paper itself."""
    found = []
    for text, heads, cells in _lines(page):
        numbers = [cell for head, cell in zip(heads, cells, strict=True) if head in HEADS and not LINK.search(cell)]
        is_of_rows = any(one["word"] is None for one in LINK.finditer(text)) or cells[:1] == ["the paper"]
        if cells != heads and not is_of_rows and any(re.search(r"\d", number) for number in numbers):
            found.append(text)
    return found


def _lines(page: Path, text: str | None = None) -> Iterator[tuple[str, list[str], list[str]]]:
    """Each line as rendered; if it is one of a table, the table's heads and its cells."""
    heads: list[str] = []
    study = cache(_study)

    @cache
    def arms(file: str, name: str) -> Arm | None:
        own = study((page.parent / file).resolve().parent)
        return Arm(*own, name) if own and not _is_planned(*own[:2], name) else None

    for line in (page.read_text(encoding="utf-8") if text is None else text).splitlines():
        cells = [cell.strip() for cell in re.split(r"(?<!\\)\|", line)[1:-1]] if line.startswith("|") else []
        heads = (heads or cells) if cells else []
        if cells and (row := next((one for one in LINK.finditer(line) if one["word"] is None), None)):
            arm = arms(row["file"], row["arm"])
            told = _numbers(arm, [head for head in heads if head in HEADS])
            cells = [next(told) if head in HEADS else cell for head, cell in zip(heads, cells, strict=True)]
            line = f"| {' | '.join(cells)} |"
        yield LINK.sub(lambda one: _linked(one, arms), line), heads, cells


def _study(folder: Path) -> tuple[Path, pd.DataFrame, Draws, dict[str, list[str]]] | None:
    """A study's folder, its rows, its draws and its means; None if it has no rows yet."""
    if (folder / ROWS).is_file():
        return folder, read_rows(folder / ROWS), read_draws(folder), read_means(folder)
    if not (ROOT / "configs" / "study" / f"{folder.name}.yaml").is_file():
        raise SystemExit(f"A page names {folder.name}, which is no study.")
    return None


def _is_planned(folder: Path, rows: pd.DataFrame, name: str) -> bool:
    """Whether a study has a setting of which it has no rows yet."""
    setting = name.split("/")[0]
    return setting not in {*rows["setting"]} and setting in read_environments(folder)


def _numbers(arm: Arm | None, heads: list[str]) -> Iterator[str]:
    """What a row says below some heads."""
    if arm is None or arm.runs.empty:
        return chain([NOT_YET], repeat("–"))
    return (HEADS[head](arm) for head in heads)


def _linked(link: re.Match[str], arms: Callable[[str, str], Arm | None]) -> str:
    """A link with its number as its text; one of a row of a table as it is."""
    arm = arms(link["file"], link["arm"])
    if link["word"] is None:
        return link[0]
    return link[0].replace(f"[{link['text']}]", f"[{_word(arm, link['word'])}]", 1)


def _word(arm: Arm | None, word: str) -> str:
    if arm is None or arm.runs.empty:
        return "0" if word == "draws" else NOT_YET
    return WORDS[word](arm)


def _over(runs: pd.DataFrame, settings: int) -> pd.DataFrame:
    """One row for each seed that ran in so many settings: sums of its counts, means of its shares and errors."""
    counted = ["episodes", *CRITERIA]
    shares = [*(f"{criterion}_rate" for criterion in CRITERIA), "heldout_mse_m2"]
    of_seeds = runs.groupby("training_seed")
    over = of_seeds[counted].sum().join(of_seeds[shares].mean())
    return over[of_seeds.size() == settings].reset_index()


def _range(estimate: Estimate) -> str:
    return f"{100 * estimate.low:.0f} to {100 * estimate.high:.0f}"


if __name__ == "__main__":
    for page in PAGES:
        if (text := render(page)) != page.read_text(encoding="utf-8"):
            page.write_text(text, encoding="utf-8")
            sys.stdout.write(f"{page.relative_to(ROOT)}\n")
