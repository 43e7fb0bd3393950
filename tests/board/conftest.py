"""A small valid submission: the expert's and the random agent's first starts on the board, as two training seeds."""

from dataclasses import replace
from pathlib import Path

import pytest
from forge import SEEING

from lerobot_constructskill.board.protocol import BoardSetting
from lerobot_constructskill.board.submission import Claim, read_submission, write_submission

ENTRIES = Path(__file__).parents[2] / "board" / "entries"
SETTINGS = {task: BoardSetting(task, episodes=2) for task in ("brick_to_bin_shifted", "block_to_bin")}


@pytest.fixture(scope="session")
def valid(tmp_path_factory) -> Path:
    """Two settings, two training seeds, two starts; the second training seed never places."""
    entries = [read_submission(ENTRIES / name) for name in ("bins_expert", "bins_random")]
    claims = [
        Claim(**vars(claim) | {"training_seed": seed})
        for seed, entry in enumerate(entries)
        for claim in entry.claims
        if claim.setting in SETTINGS and claim.evaluation_seed in SETTINGS[claim.setting].starts
    ]
    said = entries[0].declaration
    told = {"about": replace(said.about, observes="pixels"), "backend": SEEING, "versions": said.versions}
    root = tmp_path_factory.mktemp("board") / "valid"
    write_submission(root, claims, suite="bins", settings=SETTINGS, training_seeds=[0, 1], **told)
    return root
