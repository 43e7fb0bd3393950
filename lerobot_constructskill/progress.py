"""Progress bars: on a terminal their clocks move every second, in a log they print few lines."""

import sys
from collections.abc import Iterator
from contextlib import contextmanager, redirect_stderr
from io import StringIO
from threading import Event, Thread

from tqdm import tqdm

TICK_S, LOG_INTERVAL_S = 1, 5


class Progress(tqdm):
    """A `tqdm` whose clock moves during long pieces of work; a bar inside another disappears when it has finished.

    The remaining time is estimated from the average of all pieces so far. Pieces take from milliseconds to minutes and
    come in bursts, one from each worker, so that an average of the last few would jump.
    """

    def __init__(self, *args, smoothing: float = 0, leave: bool | None = None, **options):
        self._closed = Event()
        self._clock = Thread(target=self._tick, daemon=True)
        interval = 0.1 if sys.stderr.isatty() else LOG_INTERVAL_S
        super().__init__(*args, smoothing=smoothing, leave=leave, miniters=1, mininterval=interval, **options)
        if sys.stderr.isatty():
            self._clock.start()

    def close(self) -> None:
        self._closed.set()
        if self._clock.is_alive():
            self._clock.join()
        super().close()

    def _tick(self) -> None:
        while not self._closed.wait(TICK_S):
            self.refresh()


@contextmanager
def quiet() -> Iterator[None]:
    """Silence LeRobot's bars and FFmpeg's messages about its codecs."""
    import av

    av.logging.set_libav_level(av.logging.ERROR)
    with redirect_stderr(StringIO()):
        yield
