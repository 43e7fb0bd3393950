"""MkDocs' hook: which files the site has. They stand as they do in the repository, so links need no second form.

The site holds the chapters (README.md, CHANGELOG.md, docs/, the reports of results/), all that they link to, and pages
that are made of the code: of each task, of the commands, of the Python interface and of the leaderboard's entries.
"""

import os
import re
from fnmatch import fnmatch
from pathlib import Path

import board_pages
import reference
import task_pages
from mkdocs.config.defaults import MkDocsConfig
from mkdocs.structure.files import File, Files
from mkdocs.structure.pages import Page

ROOT = Path(__file__).parents[1]
ASSETS = Path(__file__).parent / "assets"
CHAPTERS = [
    ROOT / "README.md",
    ROOT / "CHANGELOG.md",
    *sorted(ROOT.glob("docs/*.md")),
    *sorted(ROOT.glob("results/*/report.md")),
]
MEDIA = {".png", ".jpg", ".mp4", ".parquet"}
LINK = re.compile(r"(?<=\]\()(?!\w+:)([^)#\s]+)")
UNUSED = re.compile(r"\.map$|/lunr/")
"""Of the theme: what debuggers and searches in other languages load."""
UNSEARCHED = "---\nsearch: {exclude: true}\n---"
LANGUAGES = {".py": "python", ".yaml": "text", "": "dockerfile"}
"""What is shown of a folder, and how: coloured, the page of all configurations would be three times as large."""


def on_files(files: Files, config: MkDocsConfig) -> Files:
    """Put the repository's files in place of those of docs/."""
    linked = reached(CHAPTERS)
    made = {**task_pages.pages(ROOT), **reference.pages(ROOT), **board_pages.files(ROOT)}
    made |= {shown(path): source_page(path) for path in linked if is_source(path)}
    theirs = [file for file in files if file.src_dir != config.docs_dir and not UNUSED.search(file.src_uri)]
    twins = config.extra["copies"] = copies(linked)
    ours = [_file(uri(path), ROOT, config) for path in linked if not is_source(path) and path not in twins]
    ours += [_file(uri(path), ASSETS.parent, config) for path in sorted(ASSETS.iterdir())]
    ours += [_file(uri(path), ROOT, config) for path in sorted(ROOT.glob("docs/films/*")) if path not in linked]
    ours += [File.generated(config, name, content=text) for name, text in made.items()]
    config.nav = expanded(config.nav, [file.src_uri for file in ours if file.is_documentation_page()])
    return Files([*theirs, *ours])


def on_page_markdown(markdown: str, page: Page, config: MkDocsConfig, **_) -> str:
    """Lead links to folders and sources to the pages that show them, to a copy to its original, a task to its page."""
    folder = (ROOT / page.file.src_uri).parent
    twins = config.extra["copies"]

    def lead(match: re.Match) -> str:
        path = Path(os.path.normpath(folder / match[0]))
        if path in twins:
            return Path(os.path.relpath(twins[path], folder)).as_posix()
        return f"{match[0].rstrip('/')}.md" if path.exists() and is_source(path) else match[0]

    markdown = LINK.sub(lead, markdown)
    return task_pages.with_links(markdown) if page.file.src_uri == "docs/tasks.md" else markdown


def on_page_content(html: str, page: Page, **_) -> str:
    """Leave the changelog and the reports out of the search's index: docs/results.md says what the reports hold."""
    if page.file.src_uri == "CHANGELOG.md" or page.file.src_uri.startswith("results/"):
        page.meta["search"] = {"exclude": True}
    return html


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


def copies(paths: list[Path]) -> dict[Path, Path]:
    """Media with the bytes of one before them, to that one: studies share runs, and so their films."""
    first: dict[bytes, Path] = {}
    originals = {path: first.setdefault(path.read_bytes(), path) for path in paths if path.suffix in MEDIA}
    return {path: original for path, original in originals.items() if path != original}


def is_source(path: Path) -> bool:
    """Whether a page has to be made that shows a file or folder."""
    return path.is_dir() or path.suffix not in {".md", *MEDIA}


def uri(path: Path) -> str:
    return path.relative_to(ASSETS.parent if path.parent == ASSETS else ROOT).as_posix()


def shown(path: Path) -> str:
    return f"{uri(path)}.md"


def source_page(path: Path) -> str:
    """A file, or every file under a folder, as blocks of code, which the search's index leaves out."""
    sources = [path] if path.is_file() else sorted(one for one in path.rglob("*") if is_text(one))
    return "\n\n".join([UNSEARCHED, f"# {uri(path)}", *map(block, sources)])


def block(path: Path) -> str:
    return f"## {path.relative_to(ROOT)}\n\n```{LANGUAGES.get(path.suffix, '')}\n{path.read_text(encoding='utf-8')}```"


def is_text(path: Path) -> bool:
    return path.is_file() and path.suffix in LANGUAGES and "__pycache__" not in path.parts


def expanded(nav: list, pages: list[str]) -> list:
    """The chapters, with the pages that fit its patterns in place of each."""
    return [one for entry in nav for one in _expanded(entry, pages)]


def _expanded(entry: str | dict, pages: list[str]) -> list:
    if isinstance(entry, dict):
        ((title, inner),) = entry.items()
        return [{title: expanded(inner, pages) if isinstance(inner, list) else inner}]
    return [page for page in pages if fnmatch(page, entry)] if "*" in entry else [entry]


def _file(name: str, folder: Path, config: MkDocsConfig) -> File:
    return File(name, str(folder), config.site_dir, config.use_directory_urls)
