"""The leaderboard as `constructskill-board` makes it, and a page of the site that leads to it."""

from pathlib import Path
from tempfile import TemporaryDirectory

from lerobot_constructskill.board.exports import TABLE
from lerobot_constructskill.board.protocol import BOARD_SUITES
from lerobot_constructskill.board.site import write_board

FOLDER = "board"


def files(root: Path) -> dict[str, str | bytes]:
    """Name of a file to its content: the board's own pages and table, and the Markdown page."""
    with TemporaryDirectory() as folder:
        pages = write_board(root / FOLDER, Path(folder))
        made = {f"{FOLDER}/{path.name}": path.read_bytes() for path in [*pages, Path(folder) / TABLE]}
    return {**made, "site/board.md": page()}


def page() -> str:
    suites = "\n".join(
        f"- [`{name}`](../{FOLDER}/{name}.html): {', '.join(suite.settings)}" for name, suite in BOARD_SUITES.items()
    )
    return (
        "# The board\n\nA page for each suite, with every entry's interval over training seeds and the outcome of "
        f"every episode:\n\n{suites}\n\n[All entries](../{FOLDER}/index.html), and every episode of them as "
        f"[one table](../{FOLDER}/{TABLE}). What an entry is and how it is checked: "
        "[Leaderboard](../docs/leaderboard.md).\n"
    )
