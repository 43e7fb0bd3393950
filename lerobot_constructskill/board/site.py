"""The board as a static site: a page a suite, each one file that needs neither network nor script."""

from collections.abc import Iterable
from datetime import UTC, datetime
from pathlib import Path

from jinja2 import Environment, FileSystemLoader, StrictUndefined
from markupsafe import Markup

from lerobot_constructskill.analysis.report.formats import percent, share_range
from lerobot_constructskill.artifacts.folders import write_text
from lerobot_constructskill.board.entries import Entry, Standing, ranks, read_entries
from lerobot_constructskill.board.exports import TABLE, write_exports
from lerobot_constructskill.board.films import films_there, write_films
from lerobot_constructskill.board.protocol import CLASSES, LEVELS, RANKED_FROM, SUITES
from lerobot_constructskill.contract import STAGES
from lerobot_constructskill.errors import InputError, plural

TEMPLATES = Path(__file__).parent / "templates"
STYLE = Path(__file__).parents[1] / "analysis" / "report" / "templates"

ERROR = "error"
CELLS = (*STAGES, ERROR)
"""What an episode's cell can be."""


def write_board(root: Path, out: Path, dataset_id: str | None = None, films: bool = False) -> list[Path]:
    """Write the pages of a board's folder, and its rows for others.

    Args:
        dataset_id: as of `exports.eval_results`, which are not written without it.
        films: make those that are missing; the pages name all that are there.

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
    pages = {f"{suite}.html": _suite_page(suite, entries, out, day) for suite in SUITES}
    pages["index.html"] = _render("index.html", entries=entries, suites=SUITES, day=day)
    for name, text in pages.items():
        write_text(out / name, text)
    write_exports(entries, out, day, dataset_id)
    if refused:
        more = f" And {len(refused) - 1} more." if len(refused) > 1 else ""
        raise InputError(f"The board in {out} is without what cannot be read. {refused[0]}{more}")
    return [out / name for name in pages]


def _suite_page(name: str, entries: list[Entry], out: Path, day: str) -> str:
    own = [entry for entry in entries if entry.said.suite == name]
    columns = list(dict.fromkeys([*SUITES[name].settings, *(one for entry in own for one in entry.said.settings)]))
    # Custom settings may be called as the suite's: they are ranked among themselves.
    classes = {kind: [entry for entry in own if entry.said.settings_class == kind] for kind in CLASSES}
    ranked = {column: _ranks(classes.values(), column) for column in columns}
    return _render(
        "suite.html",
        name=name,
        suite=SUITES[name],
        suites=SUITES,
        entries=sorted(own, key=lambda entry: _place(entry, ranked)),
        columns=columns,
        ranks=ranked,
        levels=LEVELS,
        classes=CLASSES,
        fewest=RANKED_FROM,
        cells=CELLS,
        films=lambda entry, column: films_there(entry, column, out),
        table=TABLE,
        day=day,
    )


def _ranks(classes: Iterable[list[Entry]], column: str) -> dict[str, tuple[int, bool]]:
    return {name: rank for entries in classes for name, rank in ranks(entries, column).items()}


def _place(entry: Entry, ranked: dict[str, dict[str, tuple[int, bool]]]) -> tuple:
    """Where an entry is written: policies first, by class, by ranks, the worst compared first, by rates, by name."""
    own = sorted((of[entry.name][0] for of in ranked.values() if entry.name in of), reverse=True)
    rates = [standing.placed.value for standing in entry.standings.values()]
    kind = CLASSES.index(entry.said.settings_class)
    return entry.is_reference, kind, not entry.is_ranked, own, -sum(rates) / len(rates), entry.name


def grid(standing: Standing) -> Markup:
    """Every episode of a setting as a cell: a row a training seed, a column a start; a path a kind of outcome."""
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
    return environment.get_template(template).render(**context)
