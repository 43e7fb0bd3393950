"""Writes a study's report: report.md and report.html from one template, and the figures."""

import html
import json
from functools import partial
from importlib import metadata
from pathlib import Path
from typing import Any, NotRequired, TypedDict
from urllib.parse import quote

import pandas as pd
from jinja2 import Environment, FileSystemLoader, StrictUndefined
from markupsafe import Markup

from lerobot_constructskill.analysis.report import figures, formats
from lerobot_constructskill.analysis.report.findings import SettingFindings
from lerobot_constructskill.analysis.report.summarize import summarize
from lerobot_constructskill.analysis.section import Analysis
from lerobot_constructskill.analysis.stats.power import MOST, detectable_spread_ratio, seeds_needed, wrong_order
from lerobot_constructskill.artifacts.folders import write_text
from lerobot_constructskill.errors import InputError, plural
from lerobot_constructskill.files import Yaml, read_text
from lerobot_constructskill.parsing import decode, read_fields
from lerobot_constructskill.presets import find, names
from lerobot_constructskill.study.rows import (
    KNOWN,
    PROVENANCE,
    ROWS,
    STUDY,
    check_folder,
    merged,
    ran,
    read_draws,
    read_environments,
    read_rows,
)
from lerobot_constructskill.study.spec import Variant
from lerobot_constructskill.study.timing import time_by_stage

TEMPLATES = Path(__file__).parent / "templates"

MARKDOWN = "\\`*_[]|"
"""Characters that Markdown needs a backslash before."""

COLUMNS = {
    "dataset_sha256": "Data set",
    "environment_sha256": "Environment",
    "weights_sha256": "Weights",
    "backend": "Back end",
}
"""Columns of the rows in the section on provenance."""

SHOWN = 4
"""Number of different values of a column that are listed; more are counted."""


class _Study(TypedDict):
    name: str
    analysis: NotRequired[dict[str, Any] | None]


STUDY_FILE = Yaml("a study's file", _Study)


def write_report(root: Path) -> Path:
    """Write report.html, report.md and figures/ into a study's folder and return the page.

    Both hold the same tables. Films, figures of held-out error and the study's file are on the page alone.

    Raises:
        MissingError: study.yaml or rows.parquet is missing.
        InputError: one of them cannot be read, or they do not belong together.
    """
    name, analysis, rows = read_study(root)
    draws = read_draws(root)
    findings = summarize(analysis, rows, draws)
    environments = read_environments(root)
    if unknown := set(rows["setting"]) - set(environments):
        raise InputError(f"'{root / STUDY}' has no setting '{min(unknown)}', which rows in {ROWS} are of.")
    figures.write_figures(findings, root / "figures")
    shipped = _shipped(name, rows)
    context = {
        "name": name,
        "is_shipped": shipped is not None,
        "seeds": partial(_seeds, shipped, rows),
        "tasks": {setting: env["task"] for setting, env in environments.items()},
        "study": read_text(root / STUDY),
        "findings": findings,
        "draws": draws,
        "films": partial(films, root, rows),
        "facts": provenance(root, rows),
        "stages": time_by_stage(root),
        "version": metadata.version("lerobot_env_constructskill"),
    }
    for form, finalize in {"md": _escape_markdown, "html": None}.items():
        page = _environment(finalize).get_template("report.jinja").render(form=f"{form}.jinja", **context)
        write_text(root / f"report.{form}", page)
    return root / "report.html"


def read_study(root: Path) -> tuple[str, Analysis, pd.DataFrame]:
    """Read a study's name, its analysis section and its rows. Raises as `write_report` does."""
    check_folder(root)
    study = STUDY_FILE.read(root / STUDY)
    try:
        analysis = decode(Analysis, study.get("analysis") or {})
    except InputError as error:
        raise InputError(f"'{root / STUDY}' is not a study's file: {error}") from None
    return study["name"], analysis, read_rows(root / ROWS)


def films(root: Path, rows: pd.DataFrame, setting: SettingFindings) -> list[tuple[str, Markup]]:
    """(caption, quoted path) of the first recorded episode of every variant and reference.

    Videos that are missing, or lie outside of `root`, are left out.
    """
    rows = rows[(rows["setting"] == setting.name) & rows["video"].notna()].sort_values(["training_seed", "episode"])
    recorded = [row for _, row in rows.iterrows() if _is_inside(root, row["video"])]
    first = {row["variant"]: row for row in reversed(recorded)}
    shown = [(one.label, first[one.name]) for one in setting.everything if one.name in first]
    return [(f"{label}, {_outcome(row)}", Markup(quote(row["video"]))) for label, row in shown]


def provenance(root: Path, rows: pd.DataFrame) -> list[tuple[str, str]]:
    """(name, value) of the hashes, back ends and versions of all rows, then of the entries of any provenance.json.

    Raises:
        InputError: that file is not a JSON object.
    """
    facts = []
    for column, title in COLUMNS.items():
        if len(values := sorted(rows[column].dropna().unique())):
            many = f"{len(values)} different, in the column {column} of {ROWS}"
            facts.append((title, ", ".join(values) if len(values) <= SHOWN else many))
    facts += merged(map(json.loads, rows["versions"].dropna().unique())).items()
    others = KNOWN.read(root / PROVENANCE) if (root / PROVENANCE).exists() else {}
    return facts + [(name.replace("_", " "), str(value)) for name, value in others.items()]


def _shipped(name: str, rows: pd.DataFrame) -> dict[str, Any] | None:
    """The study of ours that has this name, and all settings and variants of the rows; None if there is none."""
    if name not in names("study"):
        return None
    study = read_fields(find("study", name))
    arms = {*study["variants"], *study.get("references", {})}
    return study if {*rows["setting"]} <= {*study["settings"]} and {*rows["variant"]} <= arms else None


def _seeds(shipped: dict[str, Any] | None, rows: pd.DataFrame, setting: str, variant: str) -> str:
    """The flag that makes as many seeds of a study of ours as were made, where these are fewer than its file has."""
    if shipped is None:
        return ""
    made = ran(rows).query("setting == @setting and variant == @variant")["training_seed"].nunique()
    planned = shipped["variants"][variant].get("seeds", Variant.seeds)
    return f" --seeds={made}" if 0 < made < planned else ""


def _is_inside(root: Path, video: str) -> bool:
    path = (root / video.replace("\0", "")).resolve()
    return path.is_relative_to(root.resolve()) and path.is_file()


def _outcome(row: pd.Series) -> str:
    """ "seed 0, episode 0: placed at step 180"."""
    steps = {"placed": row["place_step"], "lifted": row["lift_step"]}
    stage = next((stage for stage in steps if pd.notna(row[stage]) and row[stage]), "not lifted")
    at = f" at step {steps[stage]}" if pd.notna(steps.get(stage)) else ""
    return f"seed {row['training_seed']}, episode {row['episode']}: {stage}{at}{', not placed' * (stage == 'lifted')}"


def _environment(finalize) -> Environment:
    environment = Environment(
        loader=FileSystemLoader(TEMPLATES),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
        keep_trailing_newline=True,
        finalize=finalize,
    )
    environment.filters |= {name: word for name, word in vars(formats).items() if callable(word)} | {"plural": plural}
    environment.globals |= {"wrong_order": wrong_order, "seeds_needed": seeds_needed, "most": MOST}
    environment.globals["detectable_spread_ratio"] = detectable_spread_ratio
    return environment


def _escape_markdown(value: object) -> object:
    """Make text plain on one line, both in Markdown and in the HTML that Markdown lets through."""
    if not isinstance(value, str) or isinstance(value, Markup):
        return value
    text = html.escape(" ".join(value.split()), quote=False)
    return Markup("".join(f"\\{character}" if character in MARKDOWN else character for character in text))
