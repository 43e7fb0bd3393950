"""What an entry laid of a plan stands beside its placements, and is replayed as they are."""

from dataclasses import replace

import numpy as np
import pytest

from lerobot_constructskill.board import explained
from lerobot_constructskill.board.entries import read_entries
from lerobot_constructskill.board.exports import TABLE
from lerobot_constructskill.board.protocol import BOARD_SUITES, BoardSetting
from lerobot_constructskill.board.replay import difference, open_simulator
from lerobot_constructskill.board.site import write_board
from lerobot_constructskill.board.submission import SCORES, Claim, read_submission, write_submission
from lerobot_constructskill.envs.recording import Episode
from lerobot_constructskill.files import read_parquet

TASK = "course_of_three"
SETTING = BoardSetting(TASK, episodes=2, episode_length=4)


@pytest.fixture
def board(valid, tmp_path):
    """Two seeds that laid 1 and 2, and 0 and 3 of three elements; nobody says so of a third submission."""
    told = read_submission(valid).declaration
    counts = {(0, 0): (1, 1), (0, 1): (2, 2), (1, 0): (0, 1), (1, 1): (3, 3)}
    claims = [
        Claim(
            SETTING.first_start + start,
            stage="none",
            steps=4,
            actions=[np.random.default_rng([seed, start]).uniform(-0.05, 0.05, 16).astype(np.float32)],
            task=TASK,
            episode_length=4,
            setting=TASK,
            training_seed=seed,
            chain=chain,
            placements=placements,
            drops=seed,
            knocks=0,
            collisions=start,
        )
        for (seed, start), (chain, placements) in counts.items()
    ]
    silent = [replace(claim, **dict.fromkeys(SCORES), actions=[-claim.flat]) for claim in claims]
    for name, own in (("told", claims), ("silent", silent)):
        said = {name: getattr(told, name) for name in ("backend", "versions")} | {
            "about": replace(told.about, name=name)
        }
        settings = {TASK: SETTING}
        root = tmp_path / "board" / "entries" / name
        write_submission(root, own, suite="wall", settings=settings, training_seeds=[0, 1], **said)
    return tmp_path / "board"


def test_a_plans_setting_has_the_steps_of_its_task():
    assert {name: one.episode_length for name, one in BOARD_SUITES["wall"].settings.items()} == {
        "course_of_three": 1200,
        "bond_of_five": 2000,
        "lintel_on_posts": 1200,
    }


def test_the_chain_is_a_mean_over_seeds_and_stands_on_the_page(board, tmp_path):
    entries = {entry.name: entry.standings[TASK].laid for entry in read_entries(board)[0]}
    assert entries["silent"] is None
    laid = entries["told"]
    assert (laid.elements, laid.chain, laid.drops, laid.knocks, laid.collisions) == (3, (1.5, 1.5, 1.5), 2, 0, 2)
    assert laid.share == pytest.approx((7 / 12, 1 / 2, 2 / 3))
    pages = {path.stem: path.read_text() for path in write_board(board, tmp_path / "out")}
    assert pages["wall"].count("chain 1.50 of 3 (1.50 to 1.50), 58.3 % in place, 2 drops, 2 collisions") == 1
    assert explained.laid(laid, False).startswith("chain 1.50 of 3, "), "of one seed there is no range"
    assert "<dt>Chain</dt>" in pages["wall"] and "<dt>Chain</dt>" not in pages["bins"]
    table = read_parquet(tmp_path / "out" / TABLE, most=1 << 20).to_pylist()
    assert [row["chain"] for row in table if row["entry"] == "told"] == [1, 2, 0, 3]


@pytest.mark.sim
@pytest.mark.slow
def test_the_counts_of_an_executed_episode_are_replayed(board):
    claim = read_submission(board / "entries" / "told").claims[1]
    env = open_simulator(claim.environment)
    env.reset(seed=claim.evaluation_seed)
    came = Episode(claim.evaluation_seed)
    for action in claim.executed:
        came.add(action, env.step(action)[-1])
    honest = replace(claim, **came.outcome, **{name: getattr(came, name) for name in SCORES})
    assert difference(env, honest) is None
    assert difference(env, replace(honest, chain=1, placements=1)) == (
        f"{claim.label}: placements is 0, not 1, chain is 0, not 1"
    )
    env.close()
