"""The moving picture of README: `moving_picture.py [FILMS OUT]` shows four tasks of docs/films beside each other.

It takes the close-ups of the experts that examples/gallery.py filmed.
"""

import sys
from itertools import zip_longest
from pathlib import Path

import av
import numpy as np
from PIL import Image

TASKS = ("brick_to_bin_shifted", "brick_on_brick", "tile_to_grid", "tenon_to_mortise")
EVERY = 3
"""Frames of a film, at 20 Hz, for each frame of the picture."""
MILLISECONDS = 150
COLOURS = 256


def main(films: str = "docs/films", out: str = "examples/pictures/tasks.gif") -> None:
    rows = list(zip_longest(*(close_ups(Path(films) / f"{task}.mp4") for task in TASKS)))
    shown = list(rows[0])
    pictures = []
    for row in rows:
        shown = [new if new is not None else last for new, last in zip(row, shown, strict=True)]
        pictures.append(Image.fromarray(np.concatenate(shown, axis=1)))
    # One palette for all: colours that change from frame to frame flicker, and do not compress.
    palette = pictures[0].quantize(COLOURS, method=Image.Quantize.FASTOCTREE, kmeans=3)
    first, *others = (one.quantize(palette=palette, dither=Image.Dither.NONE) for one in pictures)
    first.save(out, save_all=True, append_images=others, duration=MILLISECONDS, loop=0)


def close_ups(film: Path) -> list[np.ndarray]:
    """The right half of every third frame, and of the last one."""
    with av.open(film) as container:
        frames = [frame.to_ndarray(format="rgb24") for frame in container.decode(video=0)]
    return [frame[:, frame.shape[1] // 2 :] for frame in (*frames[::EVERY], frames[-1])]


if __name__ == "__main__":
    main(*sys.argv[1:])
