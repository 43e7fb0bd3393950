"""The commands that README.md and docs/ print, as a reader would type them."""

import re
from pathlib import Path

ROOT = Path(__file__).parents[1]


PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md"))]

BLOCK = re.compile(r"^```bash\n(.*?)^```$", re.MULTILINE | re.DOTALL)
SPAN = re.compile(r"`((?:constructskill|lerobot)-[a-z-]+ [^`]+)`")


def commands(page: Path) -> list[str]:
    """Those of a page's blocks of bash, each on one line, without comments."""
    return [command for block in BLOCK.findall(page.read_text()) for command in split(block)]


def spans(page: Path) -> list[str]:
    """Commands with arguments that stand in a page's text."""
    return [" ".join(span.split()) for span in SPAN.findall(BLOCK.sub("", page.read_text()))]


def split(block: str) -> list[str]:
    """Lines of a block, joined where a backslash or an open quote goes on to the next."""
    found, begun = [], ""
    for line in block.splitlines():
        line = " ".join([*begun.split(), *re.sub(r"(^|\s+)# .*", "", line).split()])
        if line.endswith("\\") or line.count("'") % 2:
            begun = line.removesuffix("\\")
        else:
            begun = ""
            found += [line] if line else []
    return found
