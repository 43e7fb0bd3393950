"""What code is: of ours the revisions of its rooms, of others' its version and a hash of its source.

A policy in development changes all day and its version does not. So its source stands beside the version in whatever
is found by a digest.
"""

import ast
import hashlib
import re
import sys
import warnings
from collections.abc import Mapping
from functools import cache
from importlib.metadata import packages_distributions
from importlib.util import find_spec
from pathlib import Path

from lerobot_constructskill.artifacts.digests import installed, known_sha256, stamp
from lerobot_constructskill.artifacts.revisions import LEFT_OUT, PACKAGE, revisions
from lerobot_constructskill.errors import MachineError

BY_VERSION = {"__main__", "lerobot", "lerobot_constructskill", "lerobot_env_constructskill", *sys.stdlib_module_names}
"""Top-level packages whose source is not hashed: LeRobot's version says enough, and our own code has revisions."""


def code_of(*names: str) -> dict[str, str]:
    """What the code of some modules is, by the name of its distribution.

    LeRobot's code is left out, and ours is told by `revisions`. Other code is told by its version, where it is
    installed, and by the start of a SHA-256 of its source: "0.1.0, source 2c26b46b68ff". Source is every file of the
    top-level package, meshes and settings too, but for `LEFT_OUT`; and of packages that it imports and that are of
    the same distribution, or of none. Other distributions that it imports are not told.

    Args:
        names: modules, or classes as `module:class`.
    """
    packages = {re.split(r"[.:]", name)[0] for name in names} - BY_VERSION
    ours = revisions(*(name for name in names if re.split(r"[.:]", name)[0] == PACKAGE.name))
    return ours | dict(_told(package) for package in sorted(packages) if _files(package))


def check_unedited(before: Mapping[str, str], now: Mapping[str, str]) -> None:
    """Let nothing be written under the name of what some code was before somebody edited it.

    Args:
        before, now: package to version and source.

    Raises:
        MachineError: they differ.
    """
    if changed := [name for name, code in now.items() if before.get(name) != code]:
        raise MachineError(
            f"{changed[0]} is not what it was when this began: it was edited, or this machine has another copy. "
            "The same command makes what is missing with what it is now."
        )


def _told(package: str) -> tuple[str, str]:
    name = _distribution(package) or package
    source = f"source {_source_sha256(package)[:12]}"
    return name, f"{version}, {source}" if (version := installed(name)) else source


def _source_sha256(package: str) -> str:
    """Hash the names and bytes of the source of a package, and of those that belong to it, as it is now."""
    total = hashlib.sha256()
    for name in sorted(_with_helpers(package)):
        for relative, path in sorted(_files(name).items()):
            total.update(f"{name}/{relative}".encode())
            total.update(bytes.fromhex(known_sha256(path)))
    return total.hexdigest()


def _with_helpers(package: str) -> set[str]:
    """A top-level package and those that belong to it."""
    found, unread = {package}, [package]
    while unread:
        for path in _files(unread.pop()).values():
            imported = _imported(*stamp(path)) - BY_VERSION - found
            helpers = {name for name in imported if _distribution(name) in (None, _distribution(package))}
            helpers = {name for name in helpers if _is_written(name)}
            found |= helpers
            unread += helpers
    return found


@cache
def _imported(path: Path, size: int, mtime_ns: int) -> set[str]:
    """The top-level packages that a file of Python imports."""
    try:
        with warnings.catch_warnings(action="ignore"):  # of another's code
            nodes = [*ast.walk(ast.parse(path.read_bytes()))] if path.suffix == ".py" else []
    except (SyntaxError, ValueError, RecursionError, MemoryError):  # half written, or too deep for the parser
        return set()
    names = [alias.name for node in nodes if isinstance(node, ast.Import) for alias in node.names]
    names += [node.module for node in nodes if isinstance(node, ast.ImportFrom) and node.level == 0 and node.module]
    return {name.partition(".")[0] for name in names}


def _distribution(package: str) -> str | None:
    """The installed distribution of a top-level package.

    The metadata of an editable installation may not list its packages; a plugin of LeRobot's is named as its package.
    """
    return next(iter(_distributions().get(package, ())), package if installed(package) else None)


_distributions = cache(packages_distributions)


def _is_written(package: str) -> bool:
    """Whether somebody wrote a module or package of this name; any folder on the path would pass for one."""
    return any(path.name in ("__init__.py", f"{package}.py") for path in _files(package).values())


def _files(package: str) -> dict[str, Path]:
    """The files of a top-level package or module, by relative path; none where there is no such thing."""
    try:
        spec = find_spec(package)
    except (ImportError, ValueError):  # the latter of `__main__`
        spec = None
    folders = [Path(folder) for folder in (spec and spec.submodule_search_locations) or ()]
    inside = {path.relative_to(folder).as_posix(): path for folder in folders for path in folder.rglob("*")}
    found = {name: path for name, path in inside.items() if path.is_file() and not LEFT_OUT.search(name)}
    if spec and spec.origin and spec.origin.endswith(".py"):
        found.setdefault(Path(spec.origin).name, Path(spec.origin))
    return found
