"""Finds the shipped configurations by name: `fast`, `suite/block_to_bin`, `paper`. Standard library only."""

import re
from pathlib import Path

from lerobot_constructskill.errors import MissingError

KINDS = ("dagger", "generate", "plan", "policy", "study", "train")

_PACKAGED = Path(__file__).parent / "configs"
FOLDER = _PACKAGED if _PACKAGED.is_dir() else Path(__file__).parents[1] / "configs"
"""Inside the package where it was installed from a wheel, beside it in a checkout."""


def names(kind: str) -> list[str]:
    """Names of the shipped configurations of a kind, one of `KINDS`."""
    folder = FOLDER / kind
    return sorted(path.relative_to(folder).with_suffix("").as_posix() for path in folder.rglob("*.yaml"))


def find(kind: str, name: str | Path, or_file: bool = True) -> Path:
    """The file of a shipped configuration.

    Args:
        kind: one of `KINDS`.
        name: of the configuration.
        or_file: whether `name` may also be a file; a configuration wins over a file of the same name.

    Raises:
        MissingError: there is neither such a name nor such a file.
    """
    if str(name) in names(kind):
        return FOLDER / kind / f"{name}.yaml"
    if or_file and Path(name).is_file():
        return Path(name)
    missing = "no file and no" if or_file else "no"
    raise MissingError(
        f"There is {missing} {kind} configuration '{name}'; the configurations are: {', '.join(names(kind))}."
    )


def description(path: Path) -> str:
    """The first sentence of the comment that a configuration opens with."""
    comment = re.match(r"(#.*\n)*", path.read_text(encoding="utf-8"))[0]
    return re.split(r"(?<=[.?!]) ", " ".join(comment.replace("#", "").split()), maxsplit=1)[0]
