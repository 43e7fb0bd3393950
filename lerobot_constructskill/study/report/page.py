"""A report's files: the page, its Markdown twin and the figures, from a study's folder."""

import html
import json
from collections.abc import Iterator
from dataclasses import dataclass
from importlib import metadata
from itertools import count
from pathlib import Path

import draccus
import pandas as pd
import yaml
from jinja2 import Environment, FileSystemLoader, StrictUndefined
from markupsafe import Markup

from lerobot_constructskill.errors import InputError, MissingError
from lerobot_constructskill.parsing import decode
from lerobot_constructskill.staging import replaced
from lerobot_constructskill.study.plan import StudyPlan
from lerobot_constructskill.study.report import figures, wording
from lerobot_constructskill.study.report.answer import answer, status
from lerobot_constructskill.study.report.collect import collect
from lerobot_constructskill.study.report.findings import Findings, SettingFindings
from lerobot_constructskill.study.report.ink import DARK, LIGHT, Drawing
from lerobot_constructskill.study.report.provenance import Film, extra_facts, films, provenance
from lerobot_constructskill.study.rows import read_rows
from lerobot_constructskill.study.stats.power import ranking, seeds_needed

TEMPLATES = Path(__file__).parent / "templates"

MARKDOWN = "\\`*_[]|"
"""Characters that a backslash makes plain in Markdown."""


@dataclass(frozen=True, eq=False)
class Section:
    """One setting of the page."""

    setting: SettingFindings
    paragraph: str
    drawings: dict[str, Drawing]
    films: list[Film]


def write_report(root: Path) -> Path:
    """Write report.html, report.md and figures/ into a study's folder and return the page.

    Raises:
        FileNotFoundError: plan.yaml or rows.parquet is not there.
        ValueError: one of them cannot be read, or the rows are another plan's.
    """
    plan, rows = read_study(root)
    findings = collect(plan, rows)
    sections = [
        Section(setting, paragraph, _drawings(setting, plan), films(root, setting, rows))
        for setting, (_, paragraph) in zip(findings.settings, answer(findings), strict=True)
    ]
    power = figures.detectable_figure(plan)
    for drawing in (power, *(drawing for section in sections for drawing in section.drawings.values())):
        drawing.save(root / "figures")
    facts = [*provenance(rows), *extra_facts(root / "provenance.json")]
    context = {"findings": findings, "plan": plan, "sections": sections, "power": power, "facts": facts}
    for name, environment in (("report.md", _environment(finalize=_escape_markdown)), ("report.html", _environment())):
        with replaced(root / name) as partial:
            partial.write_text(environment.get_template(name).render(**_shared(findings), **context))
    return root / "report.html"


def read_study(root: Path) -> tuple[StudyPlan, pd.DataFrame]:
    """Read a study's plan and rows. Raises as `write_report` does."""
    plan, rows = root / "plan.yaml", root / "rows.parquet"
    for path in (plan, rows):
        if not path.is_file():
            raise MissingError(f"'{root}' is no folder of a study: {path.name} is missing.")
    try:
        decoded = decode(StudyPlan, yaml.safe_load(plan.read_text()))
    except (InputError, yaml.YAMLError) as error:
        raise InputError(f"'{plan}' is not a study's plan: {error}") from None
    return decoded, read_rows(rows)


def _drawings(setting: SettingFindings, plan: StudyPlan) -> dict[str, Drawing]:
    drawn = {
        "outcomes": figures.outcome_figure(setting),
        "seeds": figures.grid_figure(setting, plan),
        "error": figures.error_figure(setting, plan),
        "ranking": figures.ranking_figure(setting),
    }
    return {name: drawing for name, drawing in drawn.items() if drawing is not None}


def _shared(findings: Findings) -> dict:
    return {
        "status": status(findings),
        "numbers": _numbers(),
        "version": metadata.version("lerobot_env_constructskill"),
        "plan_text": yaml.safe_dump(json.loads(json.dumps(draccus.encode(findings.plan))), sort_keys=False),
    }


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
    words = {name: word for name, word in vars(wording).items() if getattr(word, "__module__", "") == wording.__name__}
    environment.filters |= words | {"next": next, "link": Markup}  # a link's path is quoted for URLs already
    environment.globals |= {"ranking": ranking, "seeds_needed": seeds_needed, "LIGHT": LIGHT, "DARK": DARK}
    return environment


def _escape_markdown(value: object) -> object:
    """Text that neither Markdown nor the HTML that Markdown lets through reads as anything but text, on one line."""
    if not isinstance(value, str) or isinstance(value, Markup):
        return value
    text = html.escape(" ".join(value.split()), quote=False)
    return Markup("".join(f"\\{character}" if character in MARKDOWN else character for character in text))
