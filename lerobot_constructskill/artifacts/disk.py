"""A full disk, whatever shape its news arrives in: encoders, Parquet and PyTorch have their own.

Only on the outside does every one of them look alike: there is no room left.
"""

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


@contextmanager
def room_for(path: Path) -> Iterator[None]:
    """Turn what the block raises on a full disk into one sentence; `path` is what it writes.

    Raises:
        MachineError: the disk is full.
    """
    try:
        yield
    except UserError:
        raise
    except Exception as error:
        disk = disk_of(path)
        if shutil.disk_usage(disk).free >= FULL:
            raise
        raise MachineError(f"The disk of {disk} is full: make room; the same command then continues.") from error
