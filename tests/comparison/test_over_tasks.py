"""Two variants over several tasks: the mean over tasks of every seed, never of pooled episodes."""

import json

import pytest
import yaml

from lerobot_constructskill.errors import InputError
from lerobot_constructskill.scripts.compare import CompareConfig, compare
from lerobot_constructskill.study.rows import VARIANT, Row, write_rows

TASKS = {"bricks": ("brick_to_bin_shifted", 10), "blocks": ("block_to_bin", 4)}
"""Setting to its task and the episodes of a run."""


@pytest.fixture
def study(tmp_path):
    """Write a study of two variants; `placed` is variant to setting to the episodes that each seed placed."""

    def write(placed: dict[str, dict[str, list[int]]]) -> str:
        rows = [
            Row(
                run=None,
                setting=setting,
                variant=variant,
                role=VARIANT,
                training_seed=seed,
                episodes=TASKS[setting][1],
                evaluation_seed=1000 + i,
                episode=i,
                placed=i < count,
                versions=json.dumps({"lerobot": "0.6.1"}),
            )
            for variant, settings in placed.items()
            for setting, counts in settings.items()
            for seed, count in enumerate(counts)
            for i in range(TASKS[setting][1])
        ]
        write_rows(rows, tmp_path / "rows.parquet")
        settings = {name: {"env": {"task": task, "obs_type": "pixels"}} for name, (task, _) in TASKS.items()}
        (tmp_path / "study.yaml").write_text(yaml.safe_dump({"settings": settings}))
        return str(tmp_path)

    return write


def test_each_seed_counts_by_its_mean_over_tasks(study, tmp_path):
    root = study({
        "told": {"bricks": [10, 9, 8, 10, 9], "blocks": [4, 4, 3, 4, 4]},
        "untold": {"bricks": [2, 3, 2, 1, 2], "blocks": [1, 0, 1, 2, 1]},
    })  # fmt: skip
    out = tmp_path / "out"
    told = compare(CompareConfig(f"{root}:*/told", f"{root}:*/untold", out=out))
    numbers = json.loads((out / "comparison.json").read_text())
    assert numbers["rates_a"] == pytest.approx([1.0, 0.95, 0.775, 1.0, 0.95])
    assert numbers["judgement"]["mean_b"][0] == pytest.approx((0.2 + 0.25) / 2)
    assert numbers["judgement"]["spread_a"] > numbers["judgement"]["spread_b"] > 0
    assert [*numbers["tasks"]] == ["bricks", "blocks"] and "A is better than B." in told
    assert f"A  {root}:*/told" in told and "bricks                  92.0%" in told


def test_what_has_no_mean_over_the_same_tasks_is_refused(study):
    root = study({"a": {"bricks": [1, 2], "blocks": [1]}, "b": {"bricks": [3, 3]}, "c": {"blocks": [1, 1]}})
    refused = {
        (f"{root}:*/a", f"{root}:bricks/b"): "is of several tasks: name the other side as STUDY:*/VARIANT too",
        (f"{root}:*/b", f"{root}:*/c"): "ran in no setting together",
        (f"{root}:*/b", f"{root}:*/d"): "ran in no setting together",
    }
    for (a, b), said in refused.items():
        with pytest.raises(InputError, match=said.replace("*", r"\*")):
            compare(CompareConfig(a, b))
    root = study({"a": {"bricks": [1, 2], "blocks": [1]}, "b": {"bricks": [3, 3], "blocks": [1, 1]}})
    with pytest.raises(InputError, match="have other training seeds: a mean is of the same ones"):
        compare(CompareConfig(f"{root}:*/a", f"{root}:*/b"))
