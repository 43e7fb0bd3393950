"""README and docs: their links lead somewhere, they name what there is, and the README is short."""

import json
import re
import tomllib
from pathlib import Path

import pytest
from printed import PAGES

from lerobot_constructskill.contract import SHIPPED
from lerobot_constructskill.perturbations import AXES

ROOT = Path(__file__).parents[1]
LINES = {"README.md": 150, "CHANGELOG.md": 60, "docs/results.md": 200}


NOTES = sorted((ROOT / "results").glob("**/*.md"))


@pytest.mark.parametrize("page", [*PAGES, *NOTES], ids=lambda page: f"{page.parent.name}/{page.name}")
def test_links_of_a_page_lead_somewhere(page):
    links = re.findall(r"\]\(([^) ]+)[^)]*\)", page.read_text())
    assert not [link for link in links if "://" not in link and not leads_somewhere(page, *link.partition("#")[::2])]


def leads_somewhere(page: Path, path: str, heading: str) -> bool:
    target = page.parent / path if path else page
    return target.exists() and (not heading or heading in headings(target))


def headings(page: Path) -> set[str]:
    """The names by which a Markdown page's headings are linked."""
    titles = re.findall(r"^#+ (.+)$", page.read_text(), re.MULTILINE)
    return {re.sub(r"[^\w -]", "", title.lower()).replace(" ", "-") for title in titles}


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_commands_of_a_page_exist(page):
    scripts = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["scripts"]
    named = set(re.findall(r"constructskill-[a-z-]*[a-z]", page.read_text()))
    assert named <= set(scripts)


@pytest.mark.parametrize("page", LINES)
def test_what_everybody_reads_is_short(page):
    assert len((ROOT / page).read_text().splitlines()) <= LINES[page]


def test_the_readme_leads_to_every_page():
    text = (ROOT / "README.md").read_text()
    assert all(f"(docs/{page.name})" in text for page in PAGES[1:])


@pytest.mark.parametrize("axis", AXES)
def test_every_axis_has_its_row_with_its_levels(axis):
    (row,) = re.findall(rf"^\| `{axis}` \|.*\|$", (ROOT / "docs" / "tasks.md").read_text(), re.MULTILINE)
    levels = [cell.strip() for cell in row.split("|")[3:-1]]
    assert [float(level) for level in levels if level] == [*AXES[axis].levels]


@pytest.mark.parametrize("task", SHIPPED)
def test_every_shipped_task_has_its_row_picture_limits_and_film(task):
    text, _, limits = (ROOT / "docs" / "tasks.md").read_text().partition("## Known limits")
    lacking = [part for part, rows in {"tasks": text, "known limits": limits}.items() if f"| `{task}` |" not in rows]
    assert not lacking, f"docs/tasks.md lacks a row of {task} among {lacking}: see the end of docs/new_task.md"
    assert f"({Path('..') / 'examples' / 'pictures' / task}.jpg)" in text
    assert (ROOT / "docs" / "films" / f"{task}.mp4").stat().st_size < 200_000


EXPERTS = json.loads((ROOT / "benchmarks" / "experts.json").read_text())


@pytest.mark.parametrize("task", SHIPPED)
def test_the_page_says_how_often_the_expert_succeeded(task):
    assert task in EXPERTS, f"measure it: python benchmarks/experts.py {task}"
    states, failed = EXPERTS[task]["states"], EXPERTS[task]["failed"]
    said = f"in `{task}` in {states - len(failed)} " if failed else "in 100 of 100 initial states of every task"
    assert said in " ".join((ROOT / "docs" / "tasks.md").read_text().split()) and states == 100
