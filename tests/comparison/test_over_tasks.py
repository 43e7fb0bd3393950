"""Two sides over several tasks: the mean over tasks of every seed, never of pooled episodes."""

import json
import shutil

import numpy as np
import pytest
import yaml

from lerobot_constructskill.comparison.match import Asked
from lerobot_constructskill.comparison.over_tasks import match_over_tasks
from lerobot_constructskill.comparison.sides import CHECKPOINT, Side, Source, find
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
                error_kind="fault" if count is None else None,
                error="lost" if count is None else None,
                episodes=SETTINGS[setting][1],
                evaluation_seed=1000 + i,
                episode=i,
                placed=None if count is None else i < count,
                versions=json.dumps({"lerobot": "0.6.1"}),
            )
            for variant, settings in placed.items()
            for setting, counts in settings.items()
            for seed, count in enumerate(counts)
            for i in range(1 if count is None else SETTINGS[setting][1])
        ]
        write_rows(rows, tmp_path / "rows.parquet")
        settings = {name: {"env": env | {"obs_type": "pixels"}} for name, (env, _) in SETTINGS.items()}
        text = yaml.safe_dump({"settings": settings, "analysis": {"means": MEANS}}, sort_keys=False)
        (tmp_path / "study.yaml").write_text(text)
        return str(tmp_path)

    return write


@pytest.fixture
def recorded(tmp_path):
    """Write recordings of seeds that placed so many in each setting, a folder for each; returns their pattern."""

    def write(blocks: list[int], bricks: list[int], **others: list[int]) -> str:
        settings = {"blocks": blocks, "bricks": bricks, **others}
        for seed, counts in enumerate(zip(*settings.values(), strict=True)):
            for setting, count in zip(settings, counts, strict=True):
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
    assert (
        f"A  {root}:*/told: 5 training seeds of a study" in told
        and "bricks                  1000 to 1009 (10)       92.0%" in told
    )
    assert "Both were made with lerobot 0.6.1" in told and "Left out" not in told


def test_a_mean_of_the_study_is_named_and_what_one_side_alone_has_is_told(study):
    root = study({"a": {"blocks": [4, 3], "dim": [1, 0]}, "b": {"blocks": [2, 1], "bricks": [9, 9]}})
    told = compare(CompareConfig(f"{root}:dark and light/a", f"{root}:*/b"))
    assert f"A  {root}:dark and light/a: 2 training seeds of a study" in told
    assert "Left out, as A alone has or names it: dim." in told
    assert "Left out, as B alone has or names it: bricks." in told
    assert "blocks                  1000 to 1003 (4)" in told
    root = study({"a": {"blocks": [4, 3], "dim": [1, 0]}, "b": {"blocks": [2, 1], "dim": [1, 1]}})
    told = compare(CompareConfig(f"{root}:dark and light/a", f"{root}:dark and light/b"))
    assert "A, mean over tasks of each seed, %: 62 38" in told and "Left out" not in told


def test_recordings_of_several_tasks_are_a_side(study, recorded, tmp_path):
    root = study({"a": {"bricks": [10, 9], "blocks": [4, 4], "dim": [0, 0]}})
    told = compare(CompareConfig(recorded([1, 2], [5, 4]), f"{root}:*/a"))
    assert "A, mean over tasks of each seed, %: 38 45" in told and "B, mean over tasks of each seed, %: 100 95" in told
    assert f"A  {tmp_path}/recorded/seed_*: recordings of 2 training seeds" in told
    with pytest.raises(InputError, match=f"is of several tasks: name '{root}:bricks/a' as STUDY"):
        compare(CompareConfig(recorded([1, 2], [5, 4]), f"{root}:bricks/a"))
    next(tmp_path.glob("recorded/seed_1/bricks.parquet")).unlink()
    with pytest.raises(InputError, match="seed_1' has no recording of brick_to_bin_shifted: every training seed"):
        compare(CompareConfig(f"{tmp_path}/recorded/seed_*", f"{root}:*/a"))


def test_one_task_or_perturbation_is_chosen_of_recordings_of_several(study, recorded, tmp_path):
    root = study({"a": {"bricks": [10, 9], "blocks": [4, 4]}})
    several, others = recorded([1, 2], [5, 4], dim=[3, 4]), f"{tmp_path}/others/seed_*"
    shutil.copytree(tmp_path / "recorded", tmp_path / "others")
    for other in (others, f"{root}:bricks/a"):
        told = compare(CompareConfig(several, other, task="brick_to_bin_shifted"))
        assert "in brick_to_bin_shifted, at most" in told and "A  2 of 2             45.0%" in told
    told = compare(CompareConfig(several, others, task="block_to_bin", perturb="light=2"))
    assert "in block_to_bin+light=2" in told and "87.5%" in told
    told = compare(CompareConfig(several, others))
    assert "Left out, as perturbed: block_to_bin+light=2" in told and "each seed, %: 38 45" in told


def test_tasks_can_be_chosen_of_those_that_the_sides_have(study):
    root = study({"a": {"bricks": [10, 9], "blocks": [4, 4]}, "b": {"bricks": [0, 1], "blocks": [4, 4]}})
    told = compare(CompareConfig(f"{root}:*/a", f"{root}:*/b", task="brick_to_bin_shifted"))
    assert "A, mean over tasks of each seed, %: 100 90" in told and "blocks" not in told
    for task, said in (("nonsense", "Unknown task 'nonsense'"), ("tile_to_grid", "ran in no setting together")):
        with pytest.raises(InputError, match=said):
            compare(CompareConfig(f"{root}:*/a", f"{root}:*/b", task=task))


def test_checkpoints_act_where_the_other_side_did_after_everything_was_checked(study, monkeypatch, tmp_path):
    acted = []

    def evaluate(source, env, starts):
        acted.append((env["task"], len(starts)))
        return Side(
            source.name, "two checkpoints", env, [dict.fromkeys(starts, True), dict.fromkeys(starts, False)], {}
        )

    root = study({"a": {"bricks": [10, 9], "blocks": [4, 4]}, "bare": {}, "uneven": {"bricks": [1, 2], "blocks": [1]}})
    ours = Source("ours", CHECKPOINT, (tmp_path / "0", tmp_path / "1"))
    over = match_over_tasks(ours, find(f"{root}:*/a"), Asked(), evaluate, 0.05)
    assert acted == [("brick_to_bin_shifted", 10), ("block_to_bin", 4)] and over.rates_a == [1.0, 0.0]
    for variant, said in (("uneven", "have other training seeds"), ("nobody", "has no variant 'nobody'")):
        with pytest.raises(InputError, match=said):
            match_over_tasks(ours, find(f"{root}:*/{variant}"), Asked(), evaluate, 0.05)
    with pytest.raises(InputError, match="--task=bins is of several tasks: name .*bricks/a' as STUDY"):
        match_over_tasks(ours, find(f"{root}:bricks/a"), Asked({"task": "bins"}), evaluate, 0.05)
    with pytest.raises(InputError, match="ran in no setting together: .*' in none"):
        match_over_tasks(ours, find(f"{root}:*/a"), Asked({"task": "tile_to_grid"}), evaluate, 0.05)
    assert len(acted) == 2, "before anything is evaluated"


def test_a_failed_seed_is_told(study):
    root = study({"a": {"bricks": [10, 9], "blocks": [4, None]}, "b": {"bricks": [0, 1], "blocks": [4, 4]}})
    told = compare(CompareConfig(f"{root}:*/a", f"{root}:*/b"))
    assert "A, mean over tasks of each seed, %: 100 45 (failed)" in told
    assert "would give B 2.5 points" in told, "what single episodes give is not known of a side with a failed seed"


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


def test_episodes_of_tasks_that_look_alike_from_a_start_are_no_two_chances(study, tmp_path, monkeypatch):
    """The second task repeats the first: its mean varies as the one task does, and not by the root of two less."""
    monkeypatch.setitem(SETTINGS, "blocks", ({"task": "block_to_bin"}, 10))
    out = tmp_path / "out"
    root = study({name: {"bricks": [5, 6, 7, 6], "blocks": [5, 6, 7, 6]} for name in "ab"})
    compare(CompareConfig(f"{root}:*/a", f"{root}:*/b", out=out))
    numbers = json.loads((out / "comparison.json").read_text())
    assert numbers["chance_a"] == pytest.approx(numbers["tasks"]["bricks"]["chance_a"])


def test_what_has_no_mean_over_the_same_tasks_is_refused(study):
    root = study({"a": {"bricks": [1, 2], "blocks": [1]}, "b": {"bricks": [3, 3]}, "c": {"blocks": [1, 1]}})
    refused = {
        (f"{root}:*/a", f"{root}:bricks/b"): f"is of several tasks: name '{root}:bricks/b' as STUDY:*/VARIANT too",
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
