"""Where a study's numbers come from: hashes, back ends, versions, and films of what the policies do."""

import base64
import json
from dataclasses import dataclass
from pathlib import Path
from urllib.parse import quote

import pandas as pd

from lerobot_constructskill.analysis.report.findings import SettingFindings
from lerobot_constructskill.study.rows import KNOWN

INLINED = 2 * 1024**2
"""Bytes up to which a video is part of the page."""

COLUMNS = {
    "dataset_sha256": "Data set",
    "environment_sha256": "Environment",
    "weights_sha256": "Weights",
    "backend": "Back end",
}
SHOWN = 4
"""Different values of a column that are written out; more are counted."""


@dataclass(frozen=True)
class Film:
    """One episode of a variant.

    Args:
        label: the variant.
        outcome: "seed 0, episode 0: placed at step 180".
        source: data URI where the video is small, else None.
        path: quoted path from the report to the file.
    """

    label: str
    outcome: str
    source: str | None
    path: str


def films(root: Path, setting: SettingFindings, rows: pd.DataFrame) -> list[Film]:
    """The first recorded episode of every variant and reference, whatever became of it.

    Videos that are not there, or lie outside of `root`, are left out.
    """
    rows = rows[(rows["setting"] == setting.name) & rows["video"].notna()].sort_values(["training_seed", "episode"])
    found = []
    for line in setting.everything:
        own = rows[rows["variant"] == line.name]
        own = own[[_inside(root, video) for video in own["video"]]]
        if len(own):
            found.append(_film(root, line.label, own.iloc[0]))
    return found


def provenance(rows: pd.DataFrame) -> list[tuple[str, str]]:
    """(what, value or values) over all rows; package versions last."""
    facts = []
    for column, title in COLUMNS.items():
        values = sorted(rows[column].dropna().unique())
        if values:
            listed = ", ".join(str(value) for value in values[:SHOWN])
            facts.append((title, listed if len(values) <= SHOWN else f"{len(values)} different, as in rows.parquet"))
    return facts + _versions(rows)


def extra_facts(path: Path) -> list[tuple[str, str]]:
    """The entries of an optional provenance.json.

    Raises:
        InputError: the file is not a JSON object.
    """
    facts = KNOWN.read(path) if path.exists() else {}
    return [(name.replace("_", " "), str(value)) for name, value in facts.items()]


def _versions(rows: pd.DataFrame) -> list[tuple[str, str]]:
    packages: dict[str, set[str]] = {}
    for text in rows["versions"].dropna().unique():
        for package, version in json.loads(text).items():
            packages.setdefault(package, set()).add(str(version))
    return [(package, ", ".join(sorted(versions))) for package, versions in sorted(packages.items())]


def _inside(root: Path, video: str) -> bool:
    path = (root / video.replace("\0", "")).resolve()
    return path.is_relative_to(root.resolve()) and path.is_file()


def _film(root: Path, label: str, row: pd.Series) -> Film:
    path = root / row["video"]
    small = path.stat().st_size < INLINED
    source = f"data:video/mp4;base64,{base64.b64encode(path.read_bytes()).decode()}" if small else None
    outcome = f"seed {row['training_seed']}, episode {row['episode']}: {_ending(row)}"
    return Film(label, outcome, source, quote(str(row["video"])))


def _ending(row: pd.Series) -> str:
    for stage, step in (("placed", "place_step"), ("lifted", "lift_step")):
        if pd.notna(row[stage]) and row[stage]:
            only = "" if stage == "placed" else ", not placed"
            return stage + (f" at step {row[step]}" if pd.notna(row[step]) else "") + only
    return "not lifted"
