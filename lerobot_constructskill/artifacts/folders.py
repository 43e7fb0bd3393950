"""Folders and files that appear whole or not at all, however a process that writes one ends. Standard library only."""

import os
import platform
import shutil
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from glob import escape
from pathlib import Path

from lerobot_constructskill.artifacts.locks import locked
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
            yield folder
            _open_up(folder)
            folder.rename(root)
        finally:
            _clear(partial, None if root.exists() else keep)
            if not any(path.name != MARK for path in partial.iterdir()):
                shutil.rmtree(partial, ignore_errors=True)


def _open_up(folder: Path) -> None:
    """Let whoever may read a folder read what is in it.

    `tempfile`, by which LeRobot joins videos, lets nobody but their owner read files.
    """
    access = folder.stat().st_mode & 0o777
    for path in folder.rglob("*"):
        if not path.is_symlink():
            path.chmod(path.stat().st_mode | (access if path.is_dir() else access & 0o666))


def sweep(root: Path) -> None:
    """Remove what a process left beside a whole folder that was killed just before it would have done so."""
    partial = _partial(root)
    if (partial / MARK).exists():
        with suppress(TakenError), locked(partial / MARK, taken="It is in use."):
            _clear(partial)
            shutil.rmtree(partial, ignore_errors=True)
    elif partial.exists() and not any(partial.iterdir()):
        partial.rmdir()


def _partial(root: Path) -> Path:
    return root.with_name(root.name + ".partial")


def _clear(partial: Path, keep: str | None = None) -> None:
    """Remove all but what is kept and the mark, without which a killed clean-up would not be known as ours."""
    for path in partial.iterdir():
        if path.name == MARK or (path.name == keep and any(path.iterdir())):
            continue
        if path.is_dir() and not path.is_symlink():
            shutil.rmtree(path, ignore_errors=True)
        else:
            path.unlink(missing_ok=True)


@contextmanager
def replaced(path: Path) -> Iterator[Path]:
    """Yield a path beside `path` to write a file to; it becomes `path` when the block ends, whole or not at all.

    What killed processes of this machine left of the same file is removed.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    host = platform.node()
    partial = path.with_name(f".{host}-{os.getpid()}.{path.name}")  # its ending stays, for those that write by it
    for other in path.parent.glob(f".{escape(host)}-*.{escape(path.name)}"):
        if not _is_alive(other.name.removeprefix(f".{host}-").removesuffix(f".{path.name}")):
            other.unlink(missing_ok=True)
    try:
        yield partial
        os.replace(partial, path)
    finally:
        partial.unlink(missing_ok=True)


def _is_alive(process: str) -> bool:
    """Whether a number is that of a process of this machine; what is no number is somebody else's."""
    try:
        os.kill(int(process), 0)
    except ProcessLookupError:
        return False
    except (ValueError, OSError):
        return True
    return True
