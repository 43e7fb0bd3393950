"""Folders and files that appear whole or not at all, however a process that writes one ends. Standard library only."""

import fcntl
import os
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from lerobot_constructskill.errors import TakenError

MARK = ".constructskill"
"""File that tells our working folders from a user's, and that the process at work holds locked."""


@contextmanager
def staged(root: Path, keep: str | None = None) -> Iterator[Path]:
    """Yield a path to write a folder to; it becomes `root` when the block ends, and is removed if the block fails.

    The path lies in `<root>.partial`. What a killed process left there is removed first.

    Args:
        keep: name of a folder beside the path, for finished parts: what lies in it outlives a killed or failed block
            and is there again for the next one, until `root` is whole.

    Raises:
        FileExistsError: `root` exists, another process is writing it, or `<root>.partial` is not ours.
    """
    if root.exists():
        raise TakenError(f"The output folder {root} exists already; remove it or name another.")
    partial = root.with_name(root.name + ".partial")
    mark = partial / MARK
    if partial.exists() and not mark.exists():
        raise TakenError(f"{partial} is in the way and not from an interrupted run; move it away.")
    partial.mkdir(parents=True, exist_ok=True)
    with mark.open("w") as lock:
        try:
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            raise TakenError(f"Another process is writing {root} at this moment.") from None
        folder = partial / "dataset"
        try:
            shutil.rmtree(folder, ignore_errors=True)
            yield folder
            folder.rename(root)
        finally:
            shutil.rmtree(folder, ignore_errors=True)
            kept = partial / keep if keep else None
            if root.exists() or kept is None or not kept.exists() or not any(kept.iterdir()):
                shutil.rmtree(partial, ignore_errors=True)


@contextmanager
def replaced(path: Path) -> Iterator[Path]:
    """Yield a path beside `path` to write a file to; it becomes `path` when the block ends, whole or not at all."""
    path.parent.mkdir(parents=True, exist_ok=True)
    partial = path.with_name(f".{os.getpid()}.{path.name}")  # its ending stays, for those that write by it
    try:
        yield partial
        os.replace(partial, path)
    finally:
        partial.unlink(missing_ok=True)
