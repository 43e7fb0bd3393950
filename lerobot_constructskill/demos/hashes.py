"""SHA-256 of a data set's files, by which a later change is seen and two data sets are compared."""

from pathlib import Path

from lerobot_constructskill.artifacts.digests import file_sha256, files_below
from lerobot_constructskill.demos.columns import SIDECAR


def file_hashes(root: Path) -> dict[str, str]:
    """Hashes of frames, videos and metadata by relative path; the record that they stand in is left out."""
    names = (path.relative_to(root).as_posix() for path in files_below(root, "data", "videos", "meta"))
    return {name: file_sha256(root / name) for name in names if name != SIDECAR}
