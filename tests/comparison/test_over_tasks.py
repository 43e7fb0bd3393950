"""Two sides over several tasks: the mean over tasks of every seed, never of pooled episodes."""

import json

import numpy as np
import pytest
import yaml

from lerobot_constructskill.comparison.sides import find
from lerobot_constructskill.envs.recording import Episode, write_recordings
from lerobot_constructskill.errors import InputError
from lerobot_constructskill.scripts.compare import CompareConfig, compare
from lerobot_constructskill.study.rows import VARIANT, Row, write_rows

SETTINGS = {
    "bricks": ({"task": "brick_to_bin_shifted"}, 10),
    "blocks": ({"task": "block_to_bin"}, 4),
    "dim": ({"task": "block_to_bin", "perturb": "light=2"}, 4),
}
"""Setting to its environment and the episodes of a run."""

MEANS = {"dark and light": ["blocks", "dim"]}


@pytest.fixture
def study(tmp_path):
    """Write a study of some variants; `placed` is variant to setting to the episodes that each seed placed."""

    def write(placed: dict[str, dict[str, list[int]]]) -> str:
        rows = [
            Row(
                run=None,
                setting=setting,
                variant=variant,
                role=VARIANT,
                training_seed=seed,
                episodes=SETTINGS[setting][1],
                evaluation_seed=1000 + i,
                episode=i,
                placed=i < count,
                versions=json.dumps({"lerobot": "0.6.1"}),
            )
            for variant, settings in placed.items()
            for setting, counts in settings.items()
            for seed, count in enumerate(counts)
            for i in range(SETTINGS[setting][1])
        ]
        write_rows(rows, tmp_path / "rows.parquet")
        settings = {name: {"env": env | {"obs_type": "pixels"}} for name, (env, _) in SETTINGS.items()}
        text = yaml.safe_dump({"settings": settings, "analysis": {"means": MEANS}}, sort_keys=False)
        (tmp_path / "study.yaml").write_text(text)
        return str(tmp_path)

    return write


@pytest.fixture
def recorded(tmp_path):
    """Write recordings of seeds that placed so many blocks and bricks, a folder for each; returns their pattern."""

    def write(blocks: list[int], bricks: list[int]) -> str:
        for seed, counts in enumerate(zip(blocks, bricks, strict=True)):
            for setting, count in zip(("blocks", "bricks"), counts, strict=True):
                env, n = SETTINGS[setting]
                kept = [Episode(1000 + i, placed=i < count, obs_type="pixels", **env) for i in range(n)]
                write_recordings(kept, tmp_path / "recorded" / f"seed_{seed}" / f"{setting}.parquet")
        return f"{tmp_path}/recorded/seed_*"

    return write


def test_each_seed_counts_by_its_mean_over_the_tasks_that_are_not_perturbed(study, tmp_path):
    root = study({
        "told": {"bricks": [10, 9, 8, 10, 9], "blocks": [4, 4, 3, 4, 4], "dim": [0, 0, 0, 0, 0]},
        "untold": {"bricks": [2, 3, 2, 1, 2], "blocks": [1, 0, 1, 2, 1], "dim": [4, 4, 4, 4, 4]},
    })  # fmt: skip
    out = tmp_path / "out"
    told = compare(CompareConfig(f"{root}:*/told", f"{root}:*/untold", out=out))
    numbers = json.loads((out / "comparison.json").read_text())
    assert numbers["rates_a"] == pytest.approx([1.0, 0.95, 0.775, 1.0, 0.95])
    assert numbers["judgement"]["mean_b"][0] == pytest.approx((0.2 + 0.25) / 2)
    assert numbers["judgement"]["spread_a"] > numbers["judgement"]["spread_b"] > 0
    assert [*numbers["tasks"]] == ["bricks", "blocks"] and "A is better than B." in told
    assert f"A  {root}:*/told" in told and "bricks                  1000 to 1009 (10)       92.0%" in told
    assert "Both were made with lerobot 0.6.1" in told and "left out" not in told


def test_a_mean_of_the_study_is_named_and_what_one_side_alone_has_is_told(study):
    root = study({"a": {"blocks": [4, 3], "dim": [1, 0]}, "b": {"blocks": [2, 1], "bricks": [9, 9]}})
    told = compare(CompareConfig(f"{root}:dark and light/a", f"{root}:*/b"))
    assert "A alone ran in dim: left out." in told and "B alone ran in bricks: left out." in told
    assert "blocks                  1000 to 1003 (4)" in told
    root = study({"a": {"blocks": [4, 3], "dim": [1, 0]}, "b": {"blocks": [2, 1], "dim": [1, 1]}})
    told = compare(CompareConfig(f"{root}:dark and light/a", f"{root}:dark and light/b"))
    assert "A, mean over tasks of each seed, %: 62 38" in told and "left out" not in told


def test_recordings_of_several_tasks_are_a_side(study, recorded):
    root = study({"a": {"bricks": [10, 9], "blocks": [4, 4], "dim": [0, 0]}})
    told = compare(CompareConfig(recorded([1, 2], [5, 4]), f"{root}:*/a"))
    assert "A, mean over tasks of each seed, %: 38 45" in told and "B, mean over tasks of each seed, %: 100 95" in told
    with pytest.raises(InputError, match="is of several tasks: name the other side as STUDY"):
        compare(CompareConfig(recorded([1, 2], [5, 4]), f"{root}:bricks/a"))


def test_the_spread_of_single_episodes_stands_beside_that_of_seeds(study, tmp_path):
    root = study({
        "a": {"bricks": [5, 6, 7, 6], "blocks": [2, 2, 2, 2]},
        "b": {"bricks": [10] * 4, "blocks": [4] * 4},
    })  # fmt: skip
    out = tmp_path / "out"
    told = compare(CompareConfig(f"{root}:*/a", f"{root}:*/b", out=out))
    numbers = json.loads((out / "comparison.json").read_text())
    # of ten starts two were placed by some seeds, in 3 and in 1 of 4; the blocks by all or by none
    in_bricks = np.sqrt(2 * 0.75 * 0.25) / 10
    assert numbers["tasks"]["bricks"]["chance_a"] == pytest.approx(in_bricks)
    assert numbers["chance_a"] == pytest.approx(in_bricks / 2) and numbers["chance_b"] == 0
    assert "Single episodes alone would give A 3.1, B 0.0 points, were all seeds alike." in told


def test_what_has_no_mean_over_the_same_tasks_is_refused(study):
    root = study({"a": {"bricks": [1, 2], "blocks": [1]}, "b": {"bricks": [3, 3]}, "c": {"blocks": [1, 1]}})
    refused = {
        (f"{root}:*/a", f"{root}:bricks/b"): "is of several tasks: name the other side as STUDY:*/VARIANT too",
        (
            f"{root}:*/b",
            f"{root}:*/c",
        ): f"ran in no setting together: '{root}:*/b' in bricks and '{root}:*/c' in blocks",
        (f"{root}:*/b", f"{root}:*/d"): "has no variant 'd'; it has: a, b, c",
    }
    for (a, b), said in refused.items():
        with pytest.raises(InputError, match=said.replace("*", r"\*")):
            compare(CompareConfig(a, b))
    root = study({"a": {"bricks": [1, 2], "blocks": [1]}, "b": {"bricks": [3, 3], "blocks": [1, 1]}})
    with pytest.raises(InputError, match="have other training seeds: a mean is of the same ones"):
        compare(CompareConfig(f"{root}:*/a", f"{root}:*/b"))


def test_a_task_is_not_counted_twice(study, monkeypatch):
    monkeypatch.setitem(SETTINGS, "dim", (SETTINGS["blocks"][0], 4))
    root = study({name: {"blocks": [1, 2], "dim": [1, 2]} for name in "ab"})
    with pytest.raises(InputError, match=r"would count block_to_bin more than once \(blocks, dim\)"):
        compare(CompareConfig(f"{root}:*/a", f"{root}:*/b"))
    assert find(f"{root}:dark and light/a").arm == "dark and light/a"
    assert "mean over these" in compare(CompareConfig(f"{root}:dark and light/a", f"{root}:dark and light/b"))
