"""One process at a time, here or on a machine that shares the file system. Standard library only."""

import fcntl
import os
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path
from typing import TextIO

from lerobot_constructskill.errors import TakenError


@contextmanager
def locked(path: Path, taken: str | None = None) -> Iterator[None]:
    """Hold the lock of the file `path`, which the operating system frees however the process ends.

    Args:
        taken: message of the error if another process holds it; without a message, wait.

    Raises:
        TakenError: another process holds it.
    """
    lock = None
    while lock is None:
        lock = _lock(path, taken)
    with lock:
        yield


def _lock(path: Path, taken: str | None) -> TextIO | None:
    """The file, open and locked; None where the process that held it has removed it meanwhile."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with suppress(FileNotFoundError), ExitStack() as stack:
        lock = stack.enter_context(path.open("a", encoding="utf-8"))
        try:
            fcntl.flock(lock, fcntl.LOCK_EX | (fcntl.LOCK_NB if taken else 0))
        except BlockingIOError:
            raise TakenError(taken) from None
        if os.path.samestat(os.fstat(lock.fileno()), path.stat()):
            stack.pop_all()
            return lock
    return None
