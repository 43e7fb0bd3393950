"""A full disk, whatever shape its news arrives in: encoders, Parquet and PyTorch have their own.

Only on the outside does every one of them look alike: there is no room left.
"""

import errno
import os
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from lerobot_constructskill.errors import MachineError, UserError

FULL = 1 << 20
"""Bytes free below which a write that failed is taken to have failed for want of room."""


def disk_of(path: Path) -> Path:
    """The nearest folder of a path that is there."""
    return next(folder for folder in (path.absolute(), *path.absolute().parents) if folder.exists())


def _says_so(error: OSError) -> bool:
    """NumPy gives no number, and asks for the room before it writes."""
    return error.errno in (errno.ENOSPC, errno.EDQUOT) or "free space" in str(error)


@contextmanager
def room_for(path: Path) -> Iterator[None]:
    """Turn what the block raises on a full disk into one sentence; `path` is what it writes, before that is removed.

    Raises:
        MachineError: the disk is full, or that of temporary files.
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
