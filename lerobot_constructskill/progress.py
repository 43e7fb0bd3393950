"""The bars of everything that takes long: on a terminal their clocks move every second, a log gets fewer lines."""

import sys
from collections.abc import Iterator
from contextlib import contextmanager, redirect_stderr
from io import StringIO
from threading import Event, Thread

from tqdm import tqdm

TICK_S, LOG_INTERVAL_S = 1, 5


class Progress(tqdm):
    """A `tqdm` that waits for no piece of work to show that it lives; inside another bar it goes when it has finished.

    Its time to go is that of the average piece so far: ours take from milliseconds to minutes, and come in bursts, one
    from each worker, where an average of the last few would promise something else every time.
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
    """Keep what LeRobot and FFmpeg print from among our lines: a bar for each step, and how a codec fared."""
    import av

    av.logging.set_libav_level(av.logging.ERROR)
    with redirect_stderr(StringIO()):
        yield
