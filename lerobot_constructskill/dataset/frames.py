"""Checks of the videos: as many frames as rows, evenly spaced, changing when the arm moves, and found by LeRobot."""

from collections.abc import Iterator, Mapping
from itertools import islice
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from lerobot_constructskill.contract import FPS
from lerobot_constructskill.dataset.dataset import LATE_S, DataSet, video_complaints
from lerobot_constructskill.dataset.hub import open_lerobot
from lerobot_constructskill.errors import InputError, plural

if TYPE_CHECKING:
    from lerobot.datasets import LeRobotDataset

FLAT = 2.0
"""Standard deviation over a picture, of 255, below which nothing is seen on it."""

FROZEN_FRAMES, FROZEN_DISTANCE = 5, 0.03
"""Equal pictures in a row, and metres that the arm moved meanwhile, that make a frozen camera."""

READ_FRAMES = 64
"""Frames that are read in random order, from the beginning of the data set."""

FAR = 4.0
"""Mean difference of two pictures, of 255, that no two decoders' rounding makes."""

type Pictures = dict[int, np.ndarray]
"""Row to its (H, W, 3) uint8 picture."""


def check_videos(data: DataSet) -> Iterator[str]:
    """Compare the time stamps of the packets, without decoding, with the rows and the episodes' metadata."""
    for camera in data.cameras:
        frames: dict[Path, int] = {}
        for _, episode in data.episodes.iterrows():
            path = data.video(camera, episode)
            start = frames.setdefault(path, 0)
            first, last = (episode[f"videos/{camera}/{edge}_timestamp"] * FPS for edge in ("from", "to"))
            if max(abs(first - start), abs(last - first - episode["length"])) > LATE_S * FPS:
                yield (
                    f"Episode {episode['episode_index']} has {episode['length']} rows and frames "
                    f"{first:.2f} to {last:.2f} of {camera}, which do not follow on frame {start}."
                )
            frames[path] += int(episode["length"])
        for path, expected in frames.items():
            yield from video_complaints(path, path.relative_to(data.root), expected, FPS)


def check_pictures(data: DataSet) -> Iterator[str]:
    """Decode every frame: none is flat, and none stays the same while the arm moves."""
    rows, position = np.arange(len(data.rows)), data.column("observation.state")[:, :3]
    way = np.cumsum(np.linalg.norm(np.diff(position, axis=0, prepend=position[:1]), axis=1))
    for camera in data.cameras:
        flat, same, before = np.zeros(len(rows), dtype=bool), np.zeros(len(rows), dtype=bool), None
        for row, picture in pictures(data, camera):
            flat[row], same[row] = picture.std() < FLAT, before is not None and np.array_equal(picture, before)
            before = picture
        first = np.maximum.accumulate(np.where(same, 0, rows))  # the first row that shows the same picture
        frozen = (rows - first >= FROZEN_FRAMES) & (way - way[first] > FROZEN_DISTANCE)
        if flat.any():
            yield f"{camera} shows nothing in {plural(flat.sum(), 'frame')}, first {flat.argmax()}."
        if frozen.any():
            yield (
                f"{camera} repeats the frame before in {plural(frozen.sum(), 'frame')} while the arm moves, "
                f"first {frozen.argmax()}."
            )


def pictures(data: DataSet, camera: str) -> Iterator[tuple[int, np.ndarray]]:
    """Yield the row and the (H, W, 3) uint8 picture of every frame, in the order of the rows.

    Raises:
        ValueError: a video that cannot be decoded, or more or fewer frames than rows.
    """
    import av

    paths = dict.fromkeys(data.video(camera, episode) for _, episode in data.episodes.iterrows())
    row = 0
    for path in paths:
        if not path.is_file():  # a pipe would be waited for
            raise InputError(f"{path.relative_to(data.root)} is missing, or no regular file.")
        try:
            with av.open(str(path)) as video:
                for frame in video.decode(video=0):
                    if row == len(data.rows):
                        raise InputError(f"The videos of {camera} have more frames than the data set has rows.")
                    yield row, frame.to_ndarray(format="rgb24")
                    row += 1
        except (av.FFmpegError, IndexError) as error:
            raise InputError(f"{path.relative_to(data.root)} cannot be decoded ({error}).") from None
    if row < len(data.rows):
        raise InputError(f"The videos of {camera} have {row} frames, but the data set has {len(data.rows)} rows.")


def check_reading(data: DataSet) -> Iterator[str]:
    """Read frames in random order by LeRobot, as a trainer does, and compare them with those decoded in order.

    Raises:
        InputError: LeRobot cannot open the data set, or a video cannot be decoded.
    """
    shown = {camera: dict(islice(pictures(data, camera), READ_FRAMES)) for camera in data.cameras}
    rows = np.random.default_rng(0).permutation(min(READ_FRAMES, len(data.rows))).tolist()
    dataset = open_lerobot(data.config.repo_id, data.root)
    if wrong := [row for row in rows if not _is_read(dataset, row, shown)]:
        yield (
            f"LeRobot's default decoder refuses {len(wrong)} of {len(rows)} frames, or takes others for them, first "
            f"{min(wrong)}: it cannot read at random what is encoded in open groups of pictures. Encode the videos in "
            "closed groups, as constructskill-generate does, or train with --dataset.video_backend=pyav."
        )


def _is_read(dataset: "LeRobotDataset", row: int, shown: Mapping[str, Pictures]) -> bool:
    """Whether LeRobot reads a row with its own pictures, and not with those of a row beside it."""
    try:
        item = dataset[row]
    except Exception:  # each of LeRobot's decoders has errors of its own
        return False
    for camera, frames in shown.items():
        seen = item[camera].permute(1, 2, 0).numpy() * 255
        own, *others = (np.abs(seen - frames[near]).mean() for near in (row, row - 1, row + 1) if near in frames)
        if own >= FAR or any(other < own for other in others):
            return False
    return True


FRAME_CHECKS = {"Videos": check_videos, "Pictures": check_pictures, "Reading": check_reading}
