"""Whether LeRobot finds the frames that a trainer asks for: in any order, by the decoder that it takes by default.

Where that fails, it fails beside key frames, so the frames there are read. What is on them is taken from PyAV, which
decodes them one after another.
"""

from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from lerobot_constructskill.contract import FPS
from lerobot_constructskill.dataset.dataset import DataSet
from lerobot_constructskill.dataset.frames import packet_times
from lerobot_constructskill.dataset.hub import open_lerobot
from lerobot_constructskill.errors import InputError

if TYPE_CHECKING:
    from lerobot.datasets import LeRobotDataset

KEY_FRAMES = 8
"""How many key frames of each camera are decoded."""

BESIDE = range(-2, 2)
"""Frames to read beside each of them."""

FAR = 4.0
"""Mean difference of two pictures, of 255, that no two decoders' rounding makes."""

type Pictures = dict[int, np.ndarray]
"""Row to its (H, W, 3) uint8 picture."""


def check_reading(data: DataSet) -> Iterator[str]:
    """Read frames beside key frames in random order as a trainer does, and compare them with those decoded in order.

    Raises:
        InputError: LeRobot cannot open the data set, or a video cannot be decoded.
    """
    rng = np.random.default_rng(0)
    shown = {camera: _beside_key_frames(data, camera, rng) for camera in data.cameras}
    rows = rng.permutation(sorted({row for pictures in shown.values() for row in pictures}))
    by_default = open_lerobot(data.config.repo_id, data.root)
    if not (wrong := _misread(by_default, rows, shown)):
        return
    by_pyav = open_lerobot(data.config.repo_id, data.root, video_backend="pyav")
    today = "" if _misread(by_pyav, wrong, shown) else "; until then, train with --dataset.video_backend=pyav"
    yield (
        f"LeRobot's default decoder refuses {len(wrong)} of {len(rows)} frames beside key frames, or takes others for "
        f"them, first {min(wrong)}: it cannot read at random what is encoded in open groups of pictures. Make the set "
        f"again with this version of constructskill-generate and the settings that meta/constructskill.json has under "
        f"'generator'{today}."
    )


def _misread(dataset: "LeRobotDataset", rows: Iterable[int], shown: Mapping[str, Pictures]) -> list[int]:
    """The rows that LeRobot refuses to read, or reads with another row's picture."""
    return [int(row) for row in rows if not _is_read(dataset, int(row), shown)]


def _is_read(dataset: "LeRobotDataset", row: int, shown: Mapping[str, Pictures]) -> bool:
    try:
        item = dataset[row]
    except Exception:  # each of LeRobot's decoders has errors of its own
        return False
    return all(
        _is_own(item[camera].permute(1, 2, 0).numpy() * 255, row, pictures)
        for camera, pictures in shown.items()
        if row in pictures
    )


def _is_own(picture: np.ndarray, row: int, pictures: Pictures) -> bool:
    """Whether a picture is that of its row, and of none of the rows beside it."""
    own, *others = (np.abs(picture - pictures[row + by]).mean() for by in (0, -1, 1) if row + by in pictures)
    return own < FAR and all(own <= other for other in others)


def _beside_key_frames(data: DataSet, camera: str, rng: np.random.Generator) -> Pictures:
    """What PyAV decodes beside some key frames of a camera's videos."""
    firsts: dict[Path, int] = {}
    for _, episode in data.episodes.iterrows():
        firsts.setdefault(data.video(camera, episode), int(episode["dataset_from_index"]))
    times = {path: packet_times(path, path.relative_to(data.root), of_keys=True) for path in firsts}
    keys = [(path, number) for path in firsts for number in range(len(times[path]))]
    pictures: Pictures = {}
    for chosen in rng.permutation(len(keys))[:KEY_FRAMES]:
        path, number = keys[chosen]
        start, key = times[path][max(0, number - 1)], round(times[path][number] * FPS)
        frames = _decode(path, start, [key + by for by in BESIDE])
        pictures |= {firsts[path] + frame: picture for frame, picture in frames}
    return pictures


def _decode(path: Path, start: float, wanted: list[int]) -> Iterator[tuple[int, np.ndarray]]:
    """Some frames of a video by number, decoded one after another from the key frame at `start` seconds on."""
    import av

    try:
        with av.open(str(path)) as video:
            stream = video.streams.video[0]
            video.seek(round(start / stream.time_base), stream=stream)
            for frame in video.decode(stream):
                number = round(frame.time * FPS)
                if number in wanted:
                    yield number, frame.to_ndarray(format="rgb24")
                if number >= wanted[-1]:
                    return
    except (av.FFmpegError, IndexError) as error:
        raise InputError(f"{path.name} cannot be decoded ({error}).") from None
