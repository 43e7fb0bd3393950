"""Tells which code makes something: our rooms by their revisions, other packages by version and hash of the source.

A policy in development changes all day and its version does not, so digests contain its source as well.
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
    """The code of some modules, by the name of its distribution.

    LeRobot's code is left out, and our code has `revisions`. Other code has its version, where it is installed, and
    the start of a SHA-256 of its source: "0.1.0, source 2c26b46b68ff". The source is every file of the top-level
    package, meshes and settings too, without `LEFT_OUT`, and the packages that it imports from the same distribution
    or from no distribution. Other distributions are left out.

    Args:
        names: modules, or classes as `module:class`.
    """
    packages = {re.split(r"[.:]", name)[0] for name in names} - BY_VERSION
    ours = revisions(*(name for name in names if re.split(r"[.:]", name)[0] == PACKAGE.name))
    return ours | dict(_told(package) for package in sorted(packages) if _files(package))


def check_unedited(before: Mapping[str, str], now: Mapping[str, str]) -> None:
    """Refuse to write a result under the digest of code that has been edited since.

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
    """Hash the names and bytes of a package's source files, and of its helpers'."""
    total = hashlib.sha256()
    for name in sorted(_with_helpers(package)):
        for relative, path in sorted(_files(name).items()):
            total.update(f"{name}/{relative}".encode())
            total.update(bytes.fromhex(known_sha256(path)))
    return total.hexdigest()


def _with_helpers(package: str) -> set[str]:
    """A top-level package and the packages that it imports from its own distribution or from no distribution."""
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
    """The installed distribution of a top-level package; None without one.

    The metadata of an editable installation may not list its packages; a plugin of LeRobot's is named as its package.
    """
    return next(iter(_distributions().get(package, ())), package if installed(package) else None)


def modules_of(distribution: str) -> list[str]:
    """The top-level packages of a distribution, or what is called so itself."""
    return [package for package, owners in _distributions().items() if distribution in owners] or [distribution]


_distributions = cache(packages_distributions)


def _is_written(package: str) -> bool:
    """Whether there is source code of this name; any folder on the path is a namespace package without code."""
    return any(path.name in ("__init__.py", f"{package}.py") for path in _files(package).values())


def _files(package: str) -> dict[str, Path]:
    """The files of a top-level package or module, by relative path; empty if it is not there."""
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
