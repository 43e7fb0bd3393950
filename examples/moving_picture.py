"""The moving picture of README: `moving_picture.py [FILMS OUT]` shows four tasks of docs/films beside each other.

It takes the close-ups of the experts that examples/gallery.py filmed.
"""

import sys
from pathlib import Path

import numpy as np
from films import frames, side_by_side
from PIL import Image

TASKS = ("brick_to_bin_shifted", "brick_on_brick", "tile_to_grid", "tenon_to_mortise")
EVERY = 3
"""Frames of a film, at 20 Hz, for each frame of the picture."""
MILLISECONDS = 150
COLOURS = 256


def main(films: str = "docs/films", out: str = "examples/pictures/tasks.gif") -> None:
    rows = side_by_side([close_ups(Path(films) / f"{task}.mp4") for task in TASKS])
    pictures = [Image.fromarray(row) for row in rows]
    # One palette for all: colours that change from frame to frame flicker, and do not compress.
    palette = pictures[0].quantize(COLOURS, method=Image.Quantize.FASTOCTREE, kmeans=3)
    first, *others = (one.quantize(palette=palette, dither=Image.Dither.NONE) for one in pictures)
    first.save(out, save_all=True, append_images=others, duration=MILLISECONDS, loop=0)


def close_ups(film: Path) -> list[np.ndarray]:
    """The close-up, right of the square that a policy sees, in every third frame and the last one."""
    seen = frames(film)
    return [frame[:, frame.shape[0] :] for frame in (*seen[::EVERY], seen[-1])]


if __name__ == "__main__":
    main(*sys.argv[1:])
