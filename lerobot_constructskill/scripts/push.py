"""`constructskill-push`: check a data set and upload it to the Hub."""

import re
from dataclasses import dataclass
from pathlib import Path

from lerobot_constructskill.bounds import Checked, RepoId, Word
from lerobot_constructskill.errors import InputError, plural
from lerobot_constructskill.files import read_text
from lerobot_constructskill.scripts.console import run, say


@dataclass
class PushConfig(Checked):
    """Check a data set, write its card, upload it to the Hub as one commit and tag it.

    A card that somebody changed, or another version wrote, stays as it is; others get this name.

    After an interruption the same command continues.
    """

    repo_id: RepoId  # its name on the Hub, user/name
    root: Path  # its folder
    private: bool = False  # whether only its owner sees it
    tag: Word | None = None  # a version tag of yours, beside LeRobot's tag
    update: bool = False  # replace a data set that is there already


def push_dataset(config: PushConfig) -> str:
    """Push and return the commit's address.

    Raises:
        FileNotFoundError: there is no data set in `root`.
        FileExistsError: the name is taken and `update` is not set.
        ValueError: a check found something wrong.
        OSError: the Hub refused, or the connection broke.
    """
    from lerobot_constructskill.dataset.card import card_facts, render
    from lerobot_constructskill.dataset.checks import examine
    from lerobot_constructskill.dataset.dataset import open_dataset
    from lerobot_constructskill.dataset.hub import push
    from lerobot_constructskill.scripts.card import CardConfig, write_card

    data = open_dataset(config.root)
    wrong = [f"{name}: {complaint}" for name, found in examine(data) for complaint in found]
    if wrong:
        raise InputError(
            f"{config.root} is not pushed, because the checks found {plural(len(wrong), 'fault')}; {wrong[0]}"
        )
    card = config.root / "README.md"
    text = read_text(card) if card.is_file() else ""
    named = re.search(r"^# (\S+/\S+)$", text, re.MULTILINE)
    is_anothers = named and named[1] != config.repo_id
    if not text or (is_anothers and text == render(card_facts(data) | {"repo_id": named[1]})):
        say(write_card(CardConfig(config.root, config.repo_id)))
    return f"Pushed: {push(config.root, config.repo_id, config.private, config.tag, config.update)}"


def main() -> None:
    run(PushConfig, push_dataset)
