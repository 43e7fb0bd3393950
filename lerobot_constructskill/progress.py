"""Progress bars, which print few lines in a log."""

import sys
from collections.abc import Iterator
from contextlib import contextmanager, redirect_stderr
from io import StringIO

from tqdm import tqdm

LOG_INTERVAL_S = 5
"""Seconds between two lines of a bar where standard error is no terminal."""


class Progress(tqdm):
    """A `tqdm` that shows every piece of work, on a terminal at most ten times a second; in a log it prints few lines.

    The remaining time is estimated from the average of all pieces so far. Pieces take from milliseconds to minutes and
    come in bursts, one from each worker, so that an average of the last few would jump.
    """

    def __init__(self, *args, smoothing: float = 0, leave: bool | None = None, **options):
        interval = 0.1 if sys.stderr.isatty() else LOG_INTERVAL_S
        super().__init__(*args, smoothing=smoothing, leave=leave, miniters=1, mininterval=interval, **options)


@contextmanager
def quiet() -> Iterator[None]:
    """Silence LeRobot's bars and FFmpeg's messages about its codecs."""
    import av

    av.logging.set_libav_level(av.logging.ERROR)
    with redirect_stderr(StringIO()):
        yield
