"""One process at a time, here or on a machine that shares the file system. Standard library only."""

import fcntl
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from lerobot_constructskill.errors import TakenError


@contextmanager
def locked(path: Path, taken: str | None = None) -> Iterator[None]:
    """Hold the lock of the file `path`, which the operating system frees however the process ends.

    Args:
        taken: what to say where another process holds it; without it, wait.

    Raises:
        TakenError: another process holds it.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    with path.open("a") as lock:
        try:
            fcntl.flock(lock, fcntl.LOCK_EX | (fcntl.LOCK_NB if taken else 0))
        except BlockingIOError:
            raise TakenError(taken) from None
        yield
