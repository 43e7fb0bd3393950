"""MkDocs' hook: which files the site has. They stand as they do in the repository, so links need no second form.

The site holds the chapters (README.md, CHANGELOG.md, docs/, the reports of results/), all that they link to, and pages
that are made of the code.
"""

import os
import re
from fnmatch import filter as matching
from pathlib import Path

import generated
from mkdocs.config.defaults import MkDocsConfig
from mkdocs.structure.files import File, Files
from mkdocs.structure.pages import Page

ROOT = Path(__file__).parents[1]
CHAPTERS = [
    *(ROOT / "README.md", ROOT / "CHANGELOG.md"),
    *sorted(ROOT.glob("docs/*.md")),
    *sorted(ROOT.glob("results/*/report.md")),
]
UNLINKED = [*sorted(ROOT.glob("website/assets/*")), *sorted(ROOT.glob("docs/films/*"))]
"""Files that only the configuration and pages made of the code refer to."""

SHOWN_AS_THEY_ARE = {".md", ".gif", ".png", ".jpg", ".mp4", ".parquet"}
LINK = re.compile(r"(?<=\]\()(?!\w+:)([^)#\s]+)")
UNUSED = re.compile(r"\.map$|/lunr/")
"""Files of the theme for debuggers and for searches in other languages."""
SEARCHED = ("README.md", "CONTRIBUTING.md", "docs/", "site/", "datasets_cards/")
"""Pages in the search's index, by the beginning of their names; docs/results.md says what the reports hold."""
LANGUAGES = {".py": "python", ".yaml": "text", "": "dockerfile"}
"""Files of a folder that are shown, and in which colours: with them all configurations take three times the room."""


def on_files(files: Files, config: MkDocsConfig) -> Files:
    """Put the repository's files in place of those of docs/."""
    linked = reached(CHAPTERS)
    made = generated.pages(ROOT) | {f"{uri(path)}.md": source_page(path) for path in linked if is_source(path)}
    theirs = [file for file in files if file.src_dir != config.docs_dir and not UNUSED.search(file.src_uri)]
    copied = dict.fromkeys([path for path in linked if not is_source(path)] + UNLINKED)
    ours = [File(uri(path), str(ROOT), config.site_dir, config.use_directory_urls) for path in copied]
    ours += [File.generated(config, name, content=text) for name, text in made.items()]
    config.nav = expanded(config.nav, [file.src_uri for file in ours if file.is_documentation_page()])
    return Files([*theirs, *ours])


def on_page_markdown(markdown: str, page: Page, **_) -> str:
    """Lead links to folders and sources to the pages that show them."""
    if not page.file.src_uri.startswith(SEARCHED):
        page.meta["search"] = {"exclude": True}
    folder = (ROOT / page.file.src_uri).parent

    def lead(match: re.Match) -> str:
        path = Path(os.path.normpath(folder / match[0]))
        return f"{match[0].rstrip('/')}.md" if path.exists() and is_source(path) else match[0]

    return LINK.sub(lead, markdown)


def reached(pages: list[Path]) -> list[Path]:
    """The pages, and all files and folders of the repository that they link to, directly or by other pages."""
    found = dict.fromkeys(pages)
    waiting = list(pages)
    while waiting:
        page = waiting.pop()
        links = (Path(os.path.normpath(page.parent / link)) for link in LINK.findall(page.read_text()))
        new = [path for path in links if path.exists() and path not in found]
        found |= dict.fromkeys(new)
        waiting += [path for path in new if path.suffix == ".md"]
    return list(found)


def is_source(path: Path) -> bool:
    """Whether a file or folder is shown on a page made of it."""
    return path.is_dir() or path.suffix not in SHOWN_AS_THEY_ARE


def uri(path: Path) -> str:
    return path.relative_to(ROOT).as_posix()


def source_page(path: Path) -> str:
    """A file, or every file under a folder, as blocks of code."""
    files = [path] if path.is_file() else sorted(one for one in path.rglob("*") if one.is_file())
    shown = [one for one in files if one.suffix in LANGUAGES and "__pycache__" not in one.parts]
    blocks = [f"## {uri(one)}\n\n```{LANGUAGES[one.suffix]}\n{one.read_text()}```" for one in shown]
    return "\n\n".join([f"# {uri(path)}", *blocks])


def expanded(nav: list, pages: list[str]) -> list:
    """The chapters, with the pages that fit its patterns in place of each pattern."""
    chapters = []
    for entry in nav:
        if isinstance(entry, str):
            chapters += matching(pages, entry) if "*" in entry else [entry]
        else:
            ((title, inner),) = entry.items()
            chapters.append({title: expanded(inner, pages) if isinstance(inner, list) else inner})
    return chapters
