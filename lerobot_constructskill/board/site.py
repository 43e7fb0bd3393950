"""Writes the board as a static site: a page for each suite, a file that needs neither network nor script."""

from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from jinja2 import Environment, FileSystemLoader, StrictUndefined
from markupsafe import Markup

from lerobot_constructskill.analysis.report.formats import percent, share_range, whole
from lerobot_constructskill.artifacts.folders import write_text
from lerobot_constructskill.board.entries import Entry, Standing, ranks, read_entries
from lerobot_constructskill.board.explained import drawn, laid, meaning, picture
from lerobot_constructskill.board.exports import TABLE, write_exports
from lerobot_constructskill.board.films import films_there, write_films
from lerobot_constructskill.board.losses import by_seed, by_setting, checked, depends_on_seed
from lerobot_constructskill.board.protocol import BOARD_SUITES, CLASSES, LEVELS, RANKED_FROM
from lerobot_constructskill.board.recovered import MEANING, PATIENCE, STRIDES
from lerobot_constructskill.board.rerun import describe
from lerobot_constructskill.contract import STAGES, get_task
from lerobot_constructskill.errors import InputError, plural

TEMPLATES = Path(__file__).parent / "templates"
STYLE = Path(__file__).parents[1] / "analysis" / "report" / "templates"

ERROR = "error"
CELLS = (*STAGES, ERROR)
"""Kinds of outcome of an episode, each with a colour."""


def write_board(
    root: Path, out: Path, dataset_id: str | None = None, films: bool = False, documentation: str | None = None
) -> list[Path]:
    """Write the pages of a board's folder, and the exports.

    Args:
        dataset_id: as of `exports.eval_results`, which are not written without it.
        films: make those that are missing; the pages name all that are there.
        documentation: address of docs/leaderboard.md as a page, to which all pages lead back.

    Returns:
        The pages.

    Raises:
        MissingError: there is no board.
        InputError: entries cannot be read; the board is there without them.
        OSError: there is nothing to render films with.
    """
    entries, refused = read_entries(root)
    if films:
        write_films(entries, out)
    day = datetime.now(UTC).date().isoformat()
    common = {"suites": BOARD_SUITES, "day": day, "documentation": documentation}
    pages = {f"{suite}.html": _suite_page(suite, entries, out, common) for suite in BOARD_SUITES}
    pages["index.html"] = _render("index.html", entries=entries, **common)
    for name, text in pages.items():
        write_text(out / name, text)
    write_exports(entries, out, day, dataset_id)
    if refused:
        raise InputError(f"The board in {out} is without what cannot be read. {' '.join(refused)}")
    return [out / name for name in pages]


def _suite_page(name: str, entries: list[Entry], out: Path, common: dict[str, Any]) -> str:
    own = [entry for entry in entries if entry.declaration.suite == name]
    suite = BOARD_SUITES[name]
    settings = {column: one for entry in own for column, one in entry.declaration.settings.items()}
    columns = suite.settings | {column: one for column, one in settings.items() if column not in suite.settings}
    ranked = {column: ranks(own, column) for column in columns}
    return _render(
        "suite.html",
        name=name,
        suite=suite,
        entries=sorted(own, key=lambda entry: _place(entry, ranked)),
        columns=columns,
        ranks=ranked,
        levels=LEVELS,
        classes=CLASSES,
        fewest=RANKED_FROM,
        cells=CELLS,
        failed=[one for entry in own for one in entry.recoveries.values()],
        unsearched={one.name: n for one in own if not one.recoveries and (n := len(one.failures))},
        meanings=MEANING,
        patience=PATIENCE,
        strides=STRIDES,
        films=lambda entry, column: films_there(entry, column, out),
        table=TABLE,
        has_plans=any(get_task(one.task).plan for one in columns.values()),
        **common,
    )


def _place(entry: Entry, ranked: dict[str, dict[str, tuple[int, bool]]]) -> tuple:
    """Key to sort entries by: policies first, then by class, by ranks from the worst on, by rates, by name."""
    own = sorted((of[entry.name][0] for of in ranked.values() if entry.name in of), reverse=True)
    rates = [standing.placed.value for standing in entry.standings.values()]
    kind = CLASSES.index(entry.declaration.settings_class)
    return entry.is_reference, kind, not entry.is_ranked, own, -sum(rates) / len(rates), entry.name


def grid(standing: Standing) -> Markup:
    """Draw every episode of a setting as a cell: a row for each training seed, a column for each start.

    The cells of one kind of outcome are one path, which keeps pages small.
    """
    kinds: dict[str, list[str]] = {kind: [] for kind in CELLS}
    for y, claims in enumerate(standing.claims.values()):
        for x, claim in enumerate(claims):
            kinds[ERROR if claim.error is not None else claim.stage].append(f"M{x} {y}h.9v.9h-.9z")
    paths = "".join(f'<path class="{kind}" d="{"".join(cells)}"/>' for kind, cells in kinds.items() if cells)
    wide, high = max(map(len, standing.claims.values())), len(standing.claims)
    size = f'viewBox="0 0 {wide} {high}" style="width:{wide * 0.75:g}rem"'
    return Markup(f'<svg class="grid" role="img" aria-label="Outcome of every episode" {size}>{paths}</svg>')


def _render(template: str, **context) -> str:
    environment = Environment(
        loader=FileSystemLoader([TEMPLATES, STYLE]),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.filters |= {"percent": percent, "share_range": share_range, "plural": plural, "grid": grid}
    environment.filters |= {"by_setting": by_setting, "by_seed": by_seed, "checked": checked}
    environment.filters |= {"depends_on_seed": depends_on_seed, "number": whole, "rates": describe}
    environment.filters |= {"meaning": meaning, "picture": picture, "drawn": drawn, "laid": laid}
    return environment.get_template(template).render(**context)
