"""The protocol's page says what the protocol is, and its numbers are what they should be."""

import re
from pathlib import Path

import pytest
import yaml

from lerobot_constructskill.board.declaration import OBSERVES, About
from lerobot_constructskill.board.protocol import (
    BOARD_SUITES,
    CONTROL,
    FIRST_FRESH,
    LEVEL,
    LEVELS,
    PERTURBED_AXES,
    PERTURBED_TASK,
    RANKED_FROM,
    RERUN_ALPHA,
    TRAINING_SEEDS,
    BoardSetting,
    PublicValue,
    class_of,
    fresh_settings,
    fresh_start,
)
from lerobot_constructskill.contract import DEMO_SEED_START, STAGES
from lerobot_constructskill.errors import InputError

PAGE = (Path(__file__).parents[2] / "docs" / "leaderboard.md").read_text()


def rows_of_page() -> dict[str, dict[str, tuple[range, int]]]:
    """Suite to setting to its starts and steps, as the page's table has them."""
    found, suite = {}, ""
    for line in PAGE.splitlines():
        if not (cells := re.fullmatch(r"\| ?(.*?) ?\| (.*) \| (\d+)(?: to (\d+))? \| (\d+) \|", line)):
            continue
        suite = cells[1].strip("` |") or suite
        first, last = int(cells[3]), int(cells[4] or cells[3])
        names = re.findall("`([a-z0-9_]+)`", cells[2])
        for name in names[:1] if names[0] == CONTROL else names:
            found.setdefault(suite, {})[name] = (range(first, last + 1), int(cells[5]))
    return found


def test_the_pages_table_is_the_protocol():
    assert rows_of_page() == {
        suite: {name: (one.starts, one.episode_length) for name, one in of.settings.items()}
        for suite, of in BOARD_SUITES.items()
    }


def test_the_page_names_the_other_numbers():
    assert f"Training seeds** are 0 to {TRAINING_SEEDS[-1]}." in PAGE
    assert f"fewer than {RANKED_FROM} training" in PAGE
    assert f"each alone at level {LEVEL}, draw 0" in PAGE and f"`{PERTURBED_TASK}` as it is" in PAGE
    assert f"({', '.join(STAGES)})" in PAGE
    assert all(f"| {level} |" in PAGE for level in LEVELS)
    assert all(f"`{name}`" in PAGE for name in (*About.__dataclass_fields__, *OBSERVES))
    assert f"{DEMO_SEED_START:,}" in PAGE and f"p below {RERUN_ALPHA:g} in a permutation test" in PAGE


def test_the_pages_files_are_what_submit_reads():
    about, settings = (
        re.search(f"```yaml\n# {name}.yaml\n(.*?)```", PAGE, re.DOTALL)[1] for name in ("about", "settings")
    )
    assert About(**yaml.safe_load(about)).observes in OBSERVES
    assert [BoardSetting(**one).task for one in yaml.safe_load(settings).values()] == ["brick_to_bin_turned"]


def test_a_perturbed_setting_has_its_control():
    settings = BOARD_SUITES["perturbed"].settings
    perturbed = {f"+{axis}={LEVEL}+seed=0" for axis in PERTURBED_AXES}
    assert settings.keys() == {CONTROL, *PERTURBED_AXES}
    assert {one.perturbation for one in settings.values()} == {"", *perturbed}
    assert len({(one.task, one.starts, one.episode_length) for one in settings.values()}) == 1


def test_whoever_changes_a_setting_is_custom():
    settings = BOARD_SUITES["bins"].settings
    assert class_of("bins", dict(settings), [0, 3, 9]) == "standard"
    for changed in (
        {},
        {**settings, "more": BoardSetting("brick_to_bin")},
        {**settings, "block_to_bin": BoardSetting("brick_to_bin")},
    ):
        assert class_of("bins", changed, TRAINING_SEEDS) == "custom"
    assert class_of("bins", dict(settings), [0, 3, 10]) == "custom", "chosen seeds"


@pytest.mark.parametrize("wrong", [{"task": "x"}, {"episodes": 0}, {"perturb": "rain=1"}, {"first_start": 2**31 - 5}])
def test_what_is_no_setting_is_refused(wrong):
    with pytest.raises(InputError):
        BoardSetting(**{"task": "brick_to_bin", **wrong})


def test_fresh_starts_follow_from_both_values_and_meet_no_others():
    drawn = {fresh_start(sha, PublicValue(round, "ab" * 32)) for sha in "ab" * 50 for round in range(1, 101)}
    assert len(drawn) == 200 and min(drawn) >= FIRST_FRESH > DEMO_SEED_START
    fresh = fresh_settings(BOARD_SUITES["bins"].settings, max(drawn))
    assert {one.first_start for one in fresh.values()} == {max(drawn)}
    assert [one.episodes for one in fresh.values()] == [20, 20]
