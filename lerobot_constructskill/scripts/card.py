"""`constructskill-card`: write a data set's card and its two pictures into its folder."""

import json
from dataclasses import dataclass
from pathlib import Path

from lerobot_constructskill.bounds import Checked, RepoId
from lerobot_constructskill.scripts.console import run


@dataclass
class CardConfig(Checked):
    """Write README.md, pictures/contact_sheet.jpg and pictures/trajectories.png for a data set."""

    root: Path  # the data set's folder
    repo_id: RepoId | None = None  # its name on the Hub; default: the one it was generated under
    out: Path | None = None  # folder to write; default: root
    facts: Path | None = None  # also write the card's facts as JSON here


def write_card(config: CardConfig) -> str:
    """Write the card and return a line that says where.

    Raises:
        FileNotFoundError: there is no data set in `root`.
        ValueError: a file that cannot be read.
    """
    from lerobot_constructskill.artifacts.folders import write_text
    from lerobot_constructskill.dataset.card import card_facts, render
    from lerobot_constructskill.dataset.dataset import open_dataset
    from lerobot_constructskill.dataset.plots import contact_sheet, trajectories

    data, out = open_dataset(config.root), config.out or config.root
    facts = card_facts(data) | ({"repo_id": config.repo_id} if config.repo_id else {})
    contact_sheet(data, out / "pictures" / "contact_sheet.jpg")
    trajectories(data, out / "pictures" / "trajectories.png")
    write_text(out / "README.md", render(facts))
    if config.facts:
        write_text(config.facts, json.dumps(facts, indent=2) + "\n")
    return f"Card and pictures written to {out}"


def main() -> None:
    run(CardConfig, write_card)
