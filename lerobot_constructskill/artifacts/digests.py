"""SHA-256 of specifications, files and data sets, and the versions that a digest depends on. Standard library only."""

import hashlib
import json
import os
from collections.abc import Iterator
from functools import cache
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any


def digest(spec: Any) -> str:
    """The first 16 hexadecimal digits of the hash of plain values, whatever the order of their names."""
    return hashlib.sha256(json.dumps(spec, sort_keys=True).encode()).hexdigest()[:16]


def file_sha256(path: Path) -> str:
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def known_sha256(path: Path) -> str:
    """`file_sha256`, cached until the file's size or time of change differs."""
    return _known_sha256(*stamp(path))


@cache
def _known_sha256(path: Path, size: int, mtime_ns: int) -> str:
    return file_sha256(path)


def stamp(path: Path) -> tuple[Path, int, int]:
    """A file's path, size in bytes and time of change in ns: what is known of the file holds until they change."""
    status = path.stat()
    return path, status.st_size, status.st_mtime_ns


def files_below(root: Path, *folders: str) -> Iterator[Path]:
    """Yield the files below some folders of a data set, in the order of their paths.

    A folder may be a link, to a larger disk for instance: `Path.rglob` would leave out what lies there.
    """
    for folder in folders:
        found, walked = [], set()
        for parent, below, names in os.walk(root / folder, followlinks=True):
            walked.add(os.path.realpath(parent))
            below[:] = [name for name in below if os.path.realpath(Path(parent, name)) not in walked]  # no circles
            found += [path for path in (Path(parent, name) for name in names) if path.is_file()]
        yield from sorted(found)


def data_sha256(root: Path) -> str:
    """Hash the frames and videos of a data set: relative paths and bytes, in the order of the paths."""
    total = hashlib.sha256()
    for path in files_below(root, "data", "videos"):
        total.update(path.relative_to(root).as_posix().encode())
        total.update(bytes.fromhex(file_sha256(path)))
    return total.hexdigest()


finished_sha256 = cache(data_sha256)
"""`data_sha256` of a data set in a store, cached: it does not change."""


@cache
def installed(package: str) -> str | None:
    """The version of an installed package; None where it is not installed."""
    try:
        return version(package)
    except PackageNotFoundError:
        return None


def versions(*packages: str) -> dict[str, str]:
    """The versions of the installed ones of some packages."""
    return {package: found for package in packages if (found := installed(package))}
