"""The configurations that are shipped, found by name: `fast`, `suite/block_to_bin`, `paper`. Standard library only."""

import re
from pathlib import Path

from lerobot_constructskill.errors import MissingError

KINDS = ("dagger", "generate", "policy", "study", "train")

_PACKAGED = Path(__file__).parent / "configs"
FOLDER = _PACKAGED if _PACKAGED.is_dir() else Path(__file__).parents[1] / "configs"
"""Inside the package where it was installed from a wheel, beside it in a checkout."""


def names(kind: str) -> list[str]:
    """Names of the shipped configurations of a kind, one of `KINDS`."""
    folder = FOLDER / kind
    return sorted(path.relative_to(folder).with_suffix("").as_posix() for path in folder.rglob("*.yaml"))


def named(kind: str, name: str) -> Path:
    """The file of a shipped configuration.

    Raises:
        MissingError: there is no such name.
    """
    if name not in names(kind):
        raise MissingError(f"There is no {kind} configuration '{name}'; {_listed(kind)}")
    return FOLDER / kind / f"{name}.yaml"


def find(kind: str, name_or_path: str | Path) -> Path:
    """The file of a shipped configuration, or the file that was given; a name wins over a file called like it.

    Raises:
        MissingError: there is neither such a name nor such a file.
    """
    name = str(name_or_path)
    if name in names(kind):
        return named(kind, name)
    if Path(name).is_file():
        return Path(name)
    raise MissingError(f"There is no file and no {kind} configuration '{name}'; {_listed(kind)}")


def _listed(kind: str) -> str:
    return f"the configurations are: {', '.join(names(kind))}."


def description(path: Path) -> str:
    """The first sentence of the comment that a configuration opens with."""
    comment = re.match(r"(#.*\n)*", path.read_text(encoding="utf-8"))[0]
    return re.split(r"(?<=[.?!]) ", " ".join(comment.replace("#", "").split()), maxsplit=1)[0]
