"""`constructskill-status`: say which folders of a store other code than today's has made."""

from dataclasses import dataclass
from pathlib import Path

from lerobot_constructskill.errors import MissingError, plural
from lerobot_constructskill.scripts.console import command


@dataclass(frozen=True)
class StatusConfig:
    """Say of folders of a store whether the code of today would make them again, and if not, what is another.

    Args:
        root: the store, or one of its folders.
    """

    root: Path = Path("outputs/store")


@command("constructskill-status --root=outputs/store")
def status(config: StatusConfig) -> str:
    """A line for each folder that other code has made, and one for all.

    Raises:
        MissingError: there is no such folder, or nothing of a store in it.
        InputError: a specification is damaged.
    """
    from lerobot_constructskill.artifacts.differences import outdated
    from lerobot_constructskill.artifacts.store import SPEC

    found = sorted(path for depth in ("", "*/", "*/*/") for path in config.root.glob(f"{depth}{SPEC}"))
    if not found:
        raise MissingError(f"'{config.root}' is no store and no folder of one: there is no {SPEC} in it.")
    changed = {path.parent: outdated(path.parent) for path in found}
    stale = [f"{folder}: made with another {', '.join(what)}" for folder, what in changed.items() if what]
    return "\n".join([*stale, f"{plural(len(found), 'folder')}, {len(stale)} of them made with other code"])
