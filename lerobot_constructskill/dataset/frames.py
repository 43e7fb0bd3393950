"""Checks of the videos: as many frames as rows, evenly spaced, and pictures that change when the arm moves."""

from collections.abc import Iterator
from pathlib import Path

import numpy as np

from lerobot_constructskill.contract import FPS
from lerobot_constructskill.dataset.dataset import DataSet
from lerobot_constructskill.errors import InputError, plural

FLAT = 2.0
"""Standard deviation over a picture, of 255, below which nothing is seen on it."""

FROZEN_FRAMES, FROZEN_DISTANCE = 5, 0.03
"""Equal pictures in a row, and metres that the arm moved meanwhile, that make a frozen camera."""

LATE = 1e-4 * FPS
"""Share of a frame by which one may be late: LeRobot reads none that is off by more than 0.1 ms."""


def check_videos(data: DataSet) -> Iterator[str]:
    """Frame counts and time stamps of the packets, without decoding."""
    for camera in data.cameras:
        frames: dict[Path, int] = {}
        for _, episode in data.episodes.iterrows():
            path = data.video(camera, episode)
            start = frames.setdefault(path, 0)
            first, last = (episode[f"videos/{camera}/{edge}_timestamp"] * FPS for edge in ("from", "to"))
            if abs(first - start) > LATE or abs(last - first - episode["length"]) > LATE:
                yield (
                    f"Episode {episode['episode_index']} has {episode['length']} rows and frames "
                    f"{first:.2f} to {last:.2f} of {camera}, which do not follow on frame {start}."
                )
            frames[path] += int(episode["length"])
        for path, expected in frames.items():
            yield from _check_packets(path, expected, path.relative_to(data.root))


def packet_times(path: Path, name: Path, of_keys: bool = False) -> list[float]:
    """Time stamps of a video's frames in seconds, without decoding.

    Args:
        name: what to call it.
        of_keys: whether to return those of key frames alone.

    Raises:
        InputError: it is missing or cannot be read.
    """
    import av

    if not path.is_file():
        raise InputError(f"{name} is missing.")
    try:
        with av.open(str(path)) as video:
            stream = video.streams.video[0]
            return sorted(
                float(packet.pts * stream.time_base)
                for packet in video.demux(stream)
                if packet.pts is not None and (packet.is_keyframe or not of_keys)
            )
    except (av.FFmpegError, IndexError) as error:
        raise InputError(f"{name} cannot be read ({error}).") from None


def _check_packets(path: Path, expected: int, name: Path) -> Iterator[str]:
    try:
        times = packet_times(path, name)
    except InputError as error:
        yield str(error)
        return
    if len(times) != expected:
        yield f"{name} has {plural(len(times), 'frame')}, but its episodes have {expected} rows."
    elif np.abs(times - np.arange(expected) / FPS).max() > 1e-4:
        yield f"The frames of {name} are not 1/{FPS} s apart."


def check_pictures(data: DataSet) -> Iterator[str]:
    """Decode every frame: none is flat, and none stays the same while the arm moves."""
    position = data.column("observation.state")[:, :3]
    for camera in data.cameras:
        flat, frozen, run, moved, before = [], [], 0, 0.0, None
        for row, picture in pictures(data, camera):
            if picture.std() < FLAT:
                flat.append(row)
            same = before is not None and np.array_equal(picture, before)
            run, moved = (run + 1, moved + np.linalg.norm(position[row] - position[row - 1])) if same else (0, 0.0)
            if run >= FROZEN_FRAMES and moved > FROZEN_DISTANCE:
                frozen.append(row)
            before = picture
        if flat:
            yield f"{camera} shows nothing in {plural(len(flat), 'frame')}, first {flat[0]}."
        if frozen:
            yield (
                f"{camera} repeats the frame before in {plural(len(frozen), 'frame')} while the arm moves, "
                f"first {frozen[0]}."
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


FRAME_CHECKS = {"Videos": check_videos, "Pictures": check_pictures}
