"""SHA-256 of a data set's files, by which a later change is seen and two data sets are compared."""

from pathlib import Path

from lerobot_constructskill.artifacts.digests import file_sha256
from lerobot_constructskill.demos.columns import SIDECAR


def file_hashes(root: Path) -> dict[str, str]:
    """Hashes of frames, videos and metadata by relative path; the record that they stand in is left out."""
    paths = (path for folder in ("data", "videos", "meta") for path in sorted((root / folder).rglob("*.*")))
    names = (path.relative_to(root).as_posix() for path in paths if path.is_file())
    return {name: file_sha256(root / name) for name in names if name != SIDECAR}
