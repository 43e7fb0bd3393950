"""Folders and files that appear whole or not at all, however a process that writes one ends. Standard library only."""

import os
import shutil
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from glob import escape
from pathlib import Path
from secrets import token_hex

from lerobot_constructskill.artifacts.disk import room_for
from lerobot_constructskill.artifacts.locks import locked
from lerobot_constructskill.errors import TakenError

MARK = ".constructskill"
"""File that marks our working folders; the process at work holds it locked."""


@contextmanager
def staged(root: Path, keep: str | None = None) -> Iterator[Path]:
    """Yield a path to write a folder to; it becomes `root` when the block ends, and is removed if the block fails.

    The path lies in `<root>.partial`. What a killed process left there is removed first.

    Args:
        keep: name of a folder beside the path, for finished parts: what lies in it outlives a killed or failed block
            and is there again for the next one, until `root` is whole.

    Raises:
        TakenError: `root` exists, another process is writing it, or `<root>.partial` is not ours.
        MachineError: the disk is full.
    """
    root = root.absolute()  # of '.', the name beside which the parts lie is not known
    exists = f"The output folder {root} exists already; remove it or name another."
    if root.exists():
        sweep(root)
        raise TakenError(exists)
    partial = _partial(root)
    mark = partial / MARK
    if partial.exists() and not mark.exists() and any(partial.iterdir()):
        raise TakenError(f"{partial} is in the way and not from an interrupted run; move it away.")
    with locked(mark, taken=f"Another process is writing {root} at this moment."):
        folder = partial / "dataset"
        try:
            if root.exists():  # by now
                raise TakenError(exists)
            _clear(partial, keep)
            with room_for(root):
                yield folder
                _open_up(folder)
                folder.rename(root)
        finally:
            _clear(partial, None if root.exists() else keep)
            if not any(path.name != MARK for path in partial.iterdir()):
                shutil.rmtree(partial, ignore_errors=True)


def _open_up(folder: Path) -> None:
    """Give a folder's content the folder's own read permissions, and write all of it to the disk.

    LeRobot joins videos by `tempfile`, whose files only their owner can read.
    """
    access = folder.stat().st_mode & 0o777
    for path in folder.rglob("*"):
        if not path.is_symlink():
            path.chmod(path.stat().st_mode | (access if path.is_dir() else access & 0o666))
            _to_disk(path)
    _to_disk(folder)


def _to_disk(path: Path) -> None:
    """Flush a file's content, or a folder's names, to the disk: after a power cut a new name could have no content."""
    descriptor = os.open(path, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def sweep(root: Path) -> None:
    """Remove the working folder beside a whole folder, which a process left that was killed before it cleaned up."""
    partial = _partial(root)
    if (partial / MARK).exists():
        with suppress(TakenError), locked(partial / MARK, taken="It is in use."):
            _clear(partial)
            shutil.rmtree(partial, ignore_errors=True)
    elif partial.exists() and not any(partial.iterdir()):
        partial.rmdir()


def _partial(root: Path) -> Path:
    return root.parent / f"{root.name}.partial"  # of '/', which exists, the name is empty


def _clear(partial: Path, keep: str | None = None) -> None:
    """Remove all but the kept folder and the mark, which says that the folder is ours if the clean-up is killed."""
    for path in partial.iterdir():
        if path.name == MARK or (path.name == keep and any(path.iterdir())):
            continue
        if path.is_dir() and not path.is_symlink():
            shutil.rmtree(path, ignore_errors=True)
        else:
            path.unlink(missing_ok=True)


def write_text(path: Path, text: str) -> None:
    """Write a file of text, which appears whole or not at all. Raises as `replaced` does."""
    with replaced(path) as partial:
        partial.write_text(text, encoding="utf-8")


@contextmanager
def replaced(path: Path) -> Iterator[Path]:
    """Yield a path beside `path` to write a file to; it becomes `path` when the block ends, whole or not at all.

    Leftovers of killed processes are removed: a process that writes one holds it locked, on any machine.

    Raises:
        MachineError: the disk is full.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    for other in path.parent.glob(f".partial-*.{escape(path.name)}"):
        with suppress(TakenError), locked(other, taken="It is in use."):
            other.unlink(missing_ok=True)
    # Its ending stays, for those that write by it.
    partial = path.with_name(f".partial-{token_hex(8)}.{path.name}")
    with locked(partial):
        try:
            with room_for(path):
                yield partial
                _to_disk(partial)
            os.replace(partial, path)
        finally:
            partial.unlink(missing_ok=True)
