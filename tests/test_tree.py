"""The tree stays small: what may be committed beside the sources, and how much of it."""

import os
import re
import subprocess
from pathlib import Path

import pytest
import yaml

ROOT = Path(__file__).parents[1]
SHOWN = ("results", "docs", "datasets_cards", "examples")
PAGES = [ROOT / "README.md", *ROOT.glob("docs/*.md"), *ROOT.glob("results/**/*.md")]
ARCHIVES = {".7z", ".bz2", ".gz", ".rar", ".tar", ".tgz", ".whl", ".xz", ".zip", ".zst"}
OF_A_STUDY = {
    "study.yaml",
    "rows.parquet",
    "recordings.parquet",
    "report.md",
    "notes.md",
    "provenance.json",
    "timings.jsonl",
}

if not (ROOT / ".git").exists():
    pytest.skip("this is no clone", allow_module_level=True)


def kept(*folders: str) -> list[Path]:
    """Files of the folders that are committed, or would be by `git add`."""
    listing = ["git", "ls-files", "--cached", "--others", "--exclude-standard", "-z", "--", *folders]
    names = subprocess.run(listing, cwd=ROOT, capture_output=True, text=True, check=True).stdout.split("\0")
    return [ROOT / name for name in dict.fromkeys(names) if (ROOT / name).is_file()]


@pytest.mark.parametrize(("folders", "files", "megabytes"), [(SHOWN, 236, 8), (("board",), None, 25)])
def test_folders_hold_no_more_than_they_may(folders, files, megabytes):
    found = kept(*folders)
    assert files is None or len(found) <= files
    assert sum(path.stat().st_size for path in found) <= megabytes * 1e6


def test_no_archive_is_kept():
    assert not [path for path in kept() if path.suffix in ARCHIVES]


def linked() -> set[Path]:
    """What the pages show or link to."""
    return {
        Path(os.path.normpath(page.parent / link))
        for page in PAGES
        for link in re.findall(r"\]\(([^)#\s]+)", page.read_text())
    }


def test_a_published_study_is_its_rows_its_report_and_what_a_page_links_to():
    """The HTML report, films and figures of errors are made by `constructskill-study` and `constructskill-report`."""
    studies = [path for path in kept("results") if path.parent != ROOT / "results"]
    assert not {path for path in studies if path.name not in OF_A_STUDY} - linked()


def test_every_film_and_picture_is_on_a_page():
    tasks = {ROOT / "docs" / "films" / f"{path.stem}.mp4" for path in ROOT.glob("examples/pictures/*.jpg")}
    shown = kept("docs/films", "examples/pictures")
    assert not {*shown} - linked() - tasks, "tasks have their film on a page of the site"


def test_templates_and_hooks_can_be_read():
    """A forge says nothing of a template that it cannot read, and shows none."""
    for path in [*ROOT.glob(".github/**/*.yml"), ROOT / ".pre-commit-config.yaml", ROOT / "CITATION.cff"]:
        assert yaml.safe_load(path.read_text())
    hooks = yaml.safe_load((ROOT / ".pre-commit-config.yaml").read_text())["repos"]
    assert {hook["repo"] for hook in hooks} == {"local"}, "hooks fetch nothing"
