"""LeRobot holds out every eighth demonstration, of any number, by an order and a share alone."""

from pathlib import Path
from types import SimpleNamespace

import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from metadata import write_metadata

from lerobot_constructskill.contract import held_out
from lerobot_constructskill.dataset.split import Split, split, split_of
from lerobot_constructskill.errors import InputError, MissingError

NUMBERS = [2, 7, 8, 9, 15, 16, 50, 80, 100, 320, 640]


def lerobots(split: Split, tasks: list[str], monkeypatch) -> tuple[list[int], list[int]]:
    """The episodes that LeRobot trains and evaluates on; only its reading of frames is replaced."""
    from lerobot.configs.default import DatasetConfig
    from lerobot.configs.train import TrainPipelineConfig
    from lerobot.datasets import factory

    whole = SimpleNamespace(
        episodes=split.episodes,
        num_episodes=len(tasks),
        meta=SimpleNamespace(episodes={"tasks": [[t] for t in tasks]}),
    )
    monkeypatch.setattr(factory, "make_dataset", lambda cfg: whole)
    monkeypatch.setattr(factory, "resolve_delta_timestamps", lambda *_: None)
    monkeypatch.setattr(factory, "LeRobotDataset", lambda *_, episodes, **__: SimpleNamespace(episodes=episodes))
    config = TrainPipelineConfig(DatasetConfig("local/set", use_imagenet_stats=False, eval_split=split.eval_split))
    train, evaluated = factory.make_train_eval_datasets(config)
    return train.episodes, evaluated.episodes if evaluated else []


@pytest.mark.parametrize("n", NUMBERS)
def test_lerobot_holds_out_what_the_contract_does(n, monkeypatch):
    tasks = ["place it"] * n
    train, evaluated = lerobots(split([100] * n, tasks), tasks, monkeypatch)
    assert evaluated == held_out(n) and sorted(train + evaluated) == list(range(n))


@pytest.mark.parametrize("counts", [(8, 8), (80, 80), (50, 50), (16, 24, 40)])
def test_of_several_tasks_it_holds_out_the_same(counts, monkeypatch):
    tasks = [f"task {i}" for i, n in enumerate(counts) for _ in range(n)]
    train, evaluated = lerobots(split([100] * len(tasks), tasks), tasks, monkeypatch)
    assert evaluated == held_out(len(tasks)) and not set(train) & set(evaluated)


def test_tasks_that_no_share_splits_as_the_contract_does_are_refused():
    with pytest.raises(InputError, match="of this set is 10 of 80, 0 of 7 of its tasks"):
        split([100] * 87, ["a"] * 80 + ["b"] * 7)


def test_frames_are_those_that_are_trained_on(tmp_path):
    found = split_of(write_metadata(tmp_path / "set", [10 + i for i in range(17)]))
    assert found.n_held_out == 2 and found.frames == sum(10 + i for i in range(17) if i not in (7, 15))


DAMAGES = {
    "gone": (Path.unlink, "has no episodes"),
    "empty": (lambda file: file.write_bytes(b""), r"meta/episodes/.*\.parquet' cannot be read"),
    "no column": (lambda file: pq.write_table(pa.table({"episode_index": [0]}), file), "has no column length"),
}


@pytest.mark.parametrize(("damage", "said"), DAMAGES.values(), ids=DAMAGES)
def test_episodes_that_cannot_be_read_are_one_sentence(damage, said, tmp_path):
    with pytest.raises(MissingError, match="meta/info.json is missing"):
        split_of(tmp_path)
    root = write_metadata(tmp_path / "set", [10] * 9)
    for file in root.glob("meta/episodes/*/*.parquet"):
        damage(file)
    with pytest.raises(InputError, match=said):
        split_of(root)
