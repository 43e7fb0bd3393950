"""`constructskill-recover`: find until when the failed episodes of a board's policies could still be saved."""

from dataclasses import dataclass
from pathlib import Path

from lerobot_constructskill.bounds import Checked, Text, Workers
from lerobot_constructskill.errors import InputError, plural
from lerobot_constructskill.scripts.console import command


@dataclass
class RecoverConfig(Checked):
    """Have the expert take over each failed episode of a board's policies, ever later, until it places no more.

    A table for each entry is written to recovered/ in the board's folder. It needs no GPU, renderer or policy. After a
    kill, the same command goes on with the entries that are not finished.
    """

    root: Path  # the board's folder, with entries/
    entries: list[Text] | None = None  # names of entries; default: all
    workers: Workers | None = None  # processes, two at least; default: one per core


@command("constructskill-recover --root=board --entries=[NAME]")
def recover(config: RecoverConfig) -> str:
    """Write the tables that are missing or made by other code, and say what was lost.

    Raises:
        MissingError: there is no board.
        InputError: an entry that is asked for is not on it; or entries cannot be read, and the others are written.
        OSError: a worker died.
    """
    from lerobot_constructskill.board.entries import read_entries
    from lerobot_constructskill.board.losses import tell
    from lerobot_constructskill.board.recover import write_missing
    from lerobot_constructskill.board.recovered import RECOVERED

    entries, refused = read_entries(config.root)
    if absent := {*(config.entries or ())} - {one.name for one in entries}:
        raise InputError(
            f"'{config.root}' has no entry {min(absent)!a:.60} that can be read; it has "
            f"{', '.join(one.name for one in entries)}."
        )
    asked = [one.name for one in entries if config.entries is None or one.name in config.entries]
    written = write_missing(config.root, [one for one in entries if one.name in asked], config.workers)
    told = [line for one in read_entries(config.root)[0] if one.name in asked for line in tell(one)]
    if refused and config.entries is None:
        raise InputError(f"These entries were left out. {' '.join(refused)}")
    return "\n".join([*told, f"{plural(len(written), 'table')} written to {config.root / RECOVERED}"])
