"""`constructskill-check`: check a data set, here or on the Hub; one line for each check."""

from dataclasses import dataclass
from pathlib import Path

from lerobot_constructskill.bounds import Checked, RepoId, Text
from lerobot_constructskill.errors import InputError, plural
from lerobot_constructskill.scripts.console import run, say


@dataclass
class CheckConfig(Checked):
    """Check a data set of demonstrations; exit status 1 if something is wrong."""

    repo_id: RepoId | None = None  # its name; downloaded from the Hub unless root is given
    root: Path | None = None  # its folder
    revision: Text | None = None  # tag, branch or commit on the Hub


def check_dataset(config: CheckConfig) -> str:
    """Print a line for each check and return the verdict.

    Raises:
        FileNotFoundError: there is no such data set.
        ValueError: something is wrong with it, or neither a name nor a folder was given.
    """
    from lerobot_constructskill.dataset.checks import CHECKS, examine
    from lerobot_constructskill.dataset.dataset import open_dataset
    from lerobot_constructskill.dataset.hub import locate
    from lerobot_constructskill.progress import Progress

    data = open_dataset(locate(config.repo_id, config.root, config.revision))
    wrong = 0
    for name, found in examine(data):
        wrong += bool(found)
        with Progress.external_write_mode():
            say(f"{'FAIL' if found else 'OK':<4}  {name:<12}  {' '.join(found)}".rstrip())
    if wrong:
        raise InputError(f"{wrong} of {len(CHECKS)} checks found something wrong with {data.root}.")
    size = f"{plural(len(data.episodes), 'demonstration')}, {plural(len(data.rows), 'frame')}"
    return f"{size}: {len(CHECKS)} checks, nothing wrong."


def main() -> None:
    run(CheckConfig, check_dataset)
