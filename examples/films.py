"""Films side by side, for the other examples."""

from collections.abc import Sequence
from itertools import zip_longest
from pathlib import Path

import av
import numpy as np


def frames(film: Path) -> list[np.ndarray]:
    """All frames of a film, each (H, W, 3) uint8."""
    with av.open(film) as container:
        return [frame.to_ndarray(format="rgb24") for frame in container.decode(video=0)]


def side_by_side(films: Sequence[list[np.ndarray]]) -> list[np.ndarray]:
    """Frames beside each other; the last one of a shorter film stays."""
    shown, rows = [film[0] for film in films], []
    for row in zip_longest(*films):
        shown = [last if new is None else new for new, last in zip(row, shown, strict=True)]
        rows.append(np.concatenate(shown, axis=1))
    return rows
