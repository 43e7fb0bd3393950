"""Every frame is found by both of LeRobot's decoders, in any order, whatever kept it and whoever merged or edited it.

The pictures are written as the recorder writes them. Each bears its row in black and white squares, so that a read
says which frame it brought.
"""

from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from lerobot.datasets import LeRobotDataset, delete_episodes, merge_datasets, split_dataset

from lerobot_constructskill.contract import IMAGE_SIZE, get_task
from lerobot_constructskill.demos.columns import demonstration_features
from lerobot_constructskill.demos.merge import aggregate
from lerobot_constructskill.demos.shards import write_episode
from lerobot_constructskill.demos.video import VIDEOS

pytestmark = pytest.mark.slow

CAMERA, TASK = "observation.images.base", get_task("brick_to_bin")
LENGTHS = (101, 97, 103, 99)
SQUARE, BITS = 32, 9
READS = 42
"""Of each set in each order: 2,016 in all."""


def picture(row: int) -> np.ndarray:
    """A dot that moves on a slope of colours, under the row's number in squares."""
    across, down = np.meshgrid(*[np.arange(IMAGE_SIZE, dtype=np.uint8)] * 2)
    image = np.stack([across, down, np.full_like(across, 7 * row % 256)], axis=2)
    for bit in range(BITS):
        x, y = SQUARE * (bit % 5), SQUARE * (bit // 5)
        image[y : y + SQUARE, x : x + SQUARE] = 255 * (row >> bit & 1)
    x = 3 * row % (IMAGE_SIZE - 16)
    image[180:196, x : x + 16] = (255, 128, 0)
    return image


def number_on(image: np.ndarray) -> int:
    centres = [(SQUARE * (bit // 5) + SQUARE // 2, SQUARE * (bit % 5) + SQUARE // 2) for bit in range(BITS)]
    return sum(int(image[centre].mean() > 127) << bit for bit, centre in enumerate(centres))


def write(video: str, root: Path) -> LeRobotDataset:
    """Four episodes, each in a shard, merged as a generation and a round of DAgger merge theirs."""
    features = {name: demonstration_features(TASK, ["base"])[name] for name in (CAMERA, "action")}
    rows, shards = iter(range(sum(LENGTHS))), []
    for episode, length in enumerate(LENGTHS):
        frames = [{CAMERA: picture(next(rows)), "action": np.zeros(4, np.float32)} for _ in range(length)]
        shards.append(root / str(episode))
        write_episode("local/frames", TASK, features, frames, shards[-1], video)
    aggregate("local/frames", shards, root / "set", root)
    return LeRobotDataset("local/frames", root=root / "set")


def edit(dataset: LeRobotDataset, root: Path) -> dict[str, tuple[LeRobotDataset, list[int]]]:
    """The set and what lerobot-edit-dataset makes of it: each with the numbers that are on its pictures."""
    rows, (first, second, third, _) = list(range(len(dataset))), np.cumsum(LENGTHS)
    deleted = delete_episodes(dataset, [1], root / "deleted", "local/deleted")
    parts = split_dataset(dataset, {"train": 0.75, "rest": 0.25}, root / "split")
    again = merge_datasets([parts["rest"], parts["train"]], "local/again", root / "again")
    return {
        "merged": (dataset, rows),
        "deleted": (deleted, rows[:first] + rows[second:]),
        "split": (parts["train"], rows[:third]),
        "merged again": (again, rows[third:] + rows[:third]),
    }


def at_random(count: int) -> Iterator[int]:
    yield from np.random.default_rng(0).permutation(count)[:READS]


def backward(count: int) -> Iterator[int]:
    yield from range(count // 2 + READS, count // 2, -1)


def end_then_back(count: int) -> Iterator[int]:
    for step in range(READS // 2):
        yield from (count - 1 - step, 17 * step % count)


ORDERS = (at_random, backward, end_then_back)


@pytest.fixture(scope="module", params=VIDEOS)
def sets(request, tmp_path_factory):
    root = tmp_path_factory.mktemp("reading")
    return request.param, edit(write(request.param, root), root)


@pytest.mark.parametrize("decoder", ["torchcodec", "pyav"])
def test_no_frame_is_refused_and_none_is_another(sets, decoder):
    video, edited = sets
    for name, (dataset, rows) in edited.items():
        assert len(dataset) == len(rows) and len(list((dataset.root / "videos").rglob("*.mp4"))) == 1
        reader = LeRobotDataset(dataset.repo_id, root=dataset.root, video_backend=decoder)
        for order in ORDERS:
            for row in order(len(rows)):
                image = (reader[int(row)][CAMERA] * 255).round().permute(1, 2, 0).numpy()
                assert number_on(image) == rows[row], f"{name}, {order.__name__}, row {row}"
                assert video != "lossless" or np.array_equal(image, picture(rows[row]))
