"""`constructskill-board`: make the board's pages from a folder of submissions."""

from dataclasses import dataclass
from pathlib import Path

from lerobot_constructskill.bounds import Checked, RepoId, Text
from lerobot_constructskill.errors import plural
from lerobot_constructskill.scripts.console import command


@dataclass
class BoardConfig(Checked):
    """Write a page for each suite, board.parquet, and exports for LeRobot, the Hub and vla-evaluation-harness."""

    root: Path  # the board's folder, with entries/ and verified/
    out: Path = Path("outputs/board")  # folder to write
    films: bool = False  # also film, in each entry's setting, an episode that placed and one of each cause of failure
    documentation: Text | None = None  # address of docs/leaderboard.md as a page, to which the pages lead back
    dataset_id: RepoId | None = None  # the benchmark's repository on the Hub; if given, also write .eval_results


@command("constructskill-board --root=board")
def board(config: BoardConfig) -> str:
    """Write the board and say where it is.

    Raises:
        MissingError: there is no board.
        InputError: entries cannot be read; the board is there without them.
        OSError: there is nothing to render films with.
    """
    from lerobot_constructskill.board.site import write_board

    pages = write_board(config.root, config.out, config.dataset_id, config.films, config.documentation)
    return f"{plural(len(pages), 'page')} written; open {pages[-1]}"
