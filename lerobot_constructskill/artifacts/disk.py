"""Turns errors of a full disk into one sentence.

Encoders, Parquet and PyTorch report a full disk in different ways, so the free space is measured.
"""

import errno
import os
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from lerobot_constructskill.errors import MachineError, UserError

FULL = 1 << 20
"""Free bytes below which a failed write counts as a write to a full disk."""


def disk_of(path: Path) -> Path:
    """The nearest existing folder above a path."""
    return next(folder for folder in (path.absolute(), *path.absolute().parents) if folder.exists())


def check_free(path: Path, needed: float, said: str) -> None:
    """Refuse a disk with less than so many free bytes.

    Args:
        path: what is to be written, there or not.
        said: the sentence's end, after how much is free: what takes how much, and what helps.

    Raises:
        MachineError: there is less.
    """
    disk = disk_of(path.parent)
    if (free := shutil.disk_usage(disk).free) < needed:
        raise MachineError(f"{disk} has {free / 1e6:,.0f} MB free{said}")


def _says_so(error: OSError) -> bool:
    """NumPy checks the free space before it writes, and raises an OSError without a number."""
    return error.errno in (errno.ENOSPC, errno.EDQUOT) or "free space" in str(error)


@contextmanager
def room_for(path: Path) -> Iterator[None]:
    """Turn what the block raises on a full disk into one sentence.

    Args:
        path: what the block writes; it must still be there when the block ends.

    Raises:
        MachineError: the disk is full, or the disk of temporary files.
    """
    try:
        yield
    except UserError:
        raise
    except Exception as error:
        disks = [disk_of(path), disk_of(Path(os.environ.get("TMPDIR", "/tmp")))]
        full = [disk for disk in disks if shutil.disk_usage(disk).free < FULL]
        if not full and not (isinstance(error, OSError) and _says_so(error)):
            raise
        disk = (full or disks)[0]
        raise MachineError(f"The disk of {disk} is full: make room; the same command then continues.") from error
