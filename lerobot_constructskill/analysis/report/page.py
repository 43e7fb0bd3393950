"""A report's files: the page, its Markdown twin and the figures, from a study's folder."""

import html
from collections.abc import Iterator
from dataclasses import dataclass, field
from importlib import metadata
from itertools import count
from pathlib import Path
from typing import Any, NotRequired, TypedDict

import draccus
import pandas as pd
from jinja2 import Environment, FileSystemLoader, StrictUndefined
from markupsafe import Markup

from lerobot_constructskill.analysis.report import figures, wording
from lerobot_constructskill.analysis.report.answer import answer, status
from lerobot_constructskill.analysis.report.collect import collect
from lerobot_constructskill.analysis.report.findings import Findings, SettingFindings
from lerobot_constructskill.analysis.report.ink import Drawing, Picture, picture
from lerobot_constructskill.analysis.report.provenance import Film, extra_facts, films, provenance
from lerobot_constructskill.analysis.section import Analysis
from lerobot_constructskill.analysis.stats.power import MOST, seeds_needed, wrong_order
from lerobot_constructskill.artifacts.folders import write_text
from lerobot_constructskill.bounds import Text, check
from lerobot_constructskill.errors import InputError, plural
from lerobot_constructskill.files import Yaml, read_text
from lerobot_constructskill.study.rows import PROVENANCE, ROWS, STUDY, check_folder, read_rows

TEMPLATES = Path(__file__).parent / "templates"

MARKDOWN = "\\`*_[]|"
"""Characters that a backslash makes plain in Markdown."""

WORDS = (
    *(wording.chance, wording.p_value, wording.percent, wording.rare, wording.share_range, wording.signed),
    *(wording.points, wording.points_range, wording.mean_episodes, wording.episodes_range, wording.error_range),
    *(plural, wording.seeds, wording.seed_spans),
)
"""What templates may call as filters."""


class _Study(TypedDict):
    name: str
    analysis: NotRequired[dict[str, Any] | None]


STUDY_FILE = Yaml("a study's file", _Study)


@dataclass(frozen=True)
class Heading:
    """What a report reads of a study's file: it takes everything else from the rows."""

    name: Text
    analysis: Analysis = field(default_factory=Analysis)

    def __post_init__(self):
        check(self)


@dataclass(frozen=True, eq=False)
class Section:
    """One setting of the page."""

    setting: SettingFindings
    paragraph: str
    pictures: dict[str, Picture]
    films: list[Film]


def write_report(root: Path) -> Path:
    """Write report.html, report.md and figures/ into a study's folder and return the page.

    Raises:
        MissingError: study.yaml or rows.parquet is not there.
        InputError: one of them cannot be read, or they do not belong together.
    """
    heading, rows = read_study(root)
    findings = collect(heading.analysis, rows)
    (root / "figures").mkdir(exist_ok=True)
    context = {
        "name": heading.name,
        "study": read_text(root / STUDY),
        "findings": findings,
        "status": status(findings),
        "sections": _sections(root, findings, rows),
        "sweeps": picture(figures.sweep_figure(findings), root / "figures") if findings.sweeps else None,
        "power": picture(figures.detectable_figure(findings), root / "figures"),
        "facts": [*provenance(rows), *extra_facts(root / PROVENANCE)],
        "version": metadata.version("lerobot_env_constructskill"),
    }
    for file, environment in (("report.md", _environment(finalize=_escape_markdown)), ("report.html", _environment())):
        write_text(root / file, environment.get_template(file).render(numbers=_numbers(), **context))
    return root / "report.html"


def read_study(root: Path) -> tuple[Heading, pd.DataFrame]:
    """Read what a report takes of a study's file, and its rows. Raises as `write_report` does."""
    check_folder(root)
    return _read_heading(root / STUDY), read_rows(root / ROWS)


def _read_heading(path: Path) -> Heading:
    study = STUDY_FILE.read(path)
    known = {key: study[key] for key in ("name", "analysis") if study.get(key) is not None}
    try:
        return draccus.decode(Heading, known)
    except (InputError, draccus.utils.DecodingError, draccus.utils.ParsingError) as error:
        reason = error.__cause__ if isinstance(error.__cause__, InputError) else error  # draccus tells its own alone
        raise InputError(f"'{path}' is not a study's file: {reason}") from None


def _sections(root: Path, findings: Findings, rows: pd.DataFrame) -> list[Section]:
    return [
        Section(setting, paragraph, _pictures(setting, findings.episodes, root), films(root, setting, rows))
        for setting, (_, paragraph) in zip(findings.sections, answer(findings), strict=True)
    ]


def _pictures(setting: SettingFindings, episodes: int, root: Path) -> dict[str, Picture]:
    drawings: dict[str, Drawing | None] = {
        "outcomes": figures.outcome_figure(setting),
        "seeds": figures.grid_figure(setting, episodes),
        "error": figures.error_figure(setting, episodes),
        "ranking": figures.ranking_figure(setting),
    }
    return {name: picture(drawing, root / "figures") for name, drawing in drawings.items() if drawing is not None}


def _numbers() -> Iterator[str]:
    """Roman numerals for tables, one at every `numbers | next`."""
    return (wording.roman(number) for number in count(1))


def _environment(**options) -> Environment:
    environment = Environment(
        loader=FileSystemLoader(TEMPLATES),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
        keep_trailing_newline=True,
        **options,
    )
    environment.filters |= {word.__name__: word for word in WORDS}
    environment.filters |= {"next": next, "link": Markup}  # a link's path is quoted for URLs already
    environment.globals |= {"wrong_order": wrong_order, "seeds_needed": seeds_needed, "most": MOST}
    return environment


def _escape_markdown(value: object) -> object:
    """Text that neither Markdown nor the HTML that Markdown lets through reads as anything but text, on one line."""
    if not isinstance(value, str) or isinstance(value, Markup):
        return value
    text = html.escape(" ".join(value.split()), quote=False)
    return Markup("".join(f"\\{character}" if character in MARKDOWN else character for character in text))
