"""SHA-256 of files and of data sets. Standard library only."""

import hashlib
from pathlib import Path


def file_sha256(path: Path) -> str:
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def data_sha256(root: Path) -> str:
    """Hash the frames and videos of a data set: relative paths and bytes, in the order of the paths."""
    digest = hashlib.sha256()
    for path in sorted(p for folder in ("data", "videos") for p in (root / folder).rglob("*") if p.is_file()):
        digest.update(path.relative_to(root).as_posix().encode())
        digest.update(bytes.fromhex(file_sha256(path)))
    return digest.hexdigest()
