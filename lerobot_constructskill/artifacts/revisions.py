"""Tells our own code: a revision for each room that decides bytes, and for an edited room its source.

`revisions.json` keeps for each room its number, the rooms that it stands on, and a hash of each of its files: of the
syntax tree without docstrings, so that comments and layout do not count. After a change of a room, either raise its
number, if it makes other bytes, or record the new source under the old number, if the tests that the table names pass:

    python -m lerobot_constructskill.artifacts.revisions --raise demos
    python -m lerobot_constructskill.artifacts.revisions --keep demos

Where the source is not the one in the table, because somebody edited it, its hash takes the place of the number.
"""

import argparse
import ast
import hashlib
import json
import os
import re
from collections.abc import Iterable, Iterator
from contextlib import suppress
from functools import cache, lru_cache
from pathlib import Path
from time import monotonic
from typing import Any, TypedDict

from lerobot_constructskill.artifacts.digests import digest, file_sha256, stamp
from lerobot_constructskill.errors import MachineError, plural
from lerobot_constructskill.files import Json

PACKAGE = Path(__file__).parents[1]
TABLE = Path(__file__).with_name("revisions.json")
PREFIX = "constructskill."
"""Before a room's name where it stands beside those of packages."""

LEFT_OUT = re.compile(r"(^|/)(\.|__pycache__/|[^/]*(~|\.pyc|\.swp|\.log)$|4913$)")
"""Files beside a package's own: hidden ones, bytecode, logs, and what editors leave for as long as a file is open."""

LOOKED_AT_S = 1.0
"""Seconds for which the files of a room are not looked at again: the status of all studies asks 46,000 times."""

EDITED = "edited: "
"""Before the file where the source stands in place of a revision."""

BEFORE = "before revisions"
"""Stands in place of a revision in rows that are older than revisions."""


class Room(TypedDict):
    """A room of the table.

    holds: its files and folders, below the package.
    stands_on: rooms without which it makes nothing, whose revisions are told beside its own.
    takes: rooms that make its inputs; these have revisions of their own.
    held_by: the tests that show whether it makes the same bytes.
    """

    holds: list[str]
    stands_on: list[str]
    takes: list[str]
    held_by: list[str]
    revision: int
    sources: dict[str, str]


ROOMS = Json("a table of revisions", dict[str, Room])


def revisions(*modules: str) -> dict[str, str]:
    """The revisions of the rooms of some of our modules and of those that they stand on, by `constructskill.<room>`.

    Raises:
        MachineError: the table and the files of the package do not belong together.
    """
    rooms = read_table()
    names = {room for module in modules for room in rooms if _is_in(module, rooms[room]["holds"])}
    while more := {below for name in names for below in rooms[name]["stands_on"]} - names:
        names |= more
    return {f"{PREFIX}{name}": revision(rooms[name]) for name in sorted(names)}


def revision(room: Room) -> str:
    """A room's number, or its source and the files that were edited."""
    found = sources(room)
    if found == room["sources"]:
        return str(room["revision"])
    edited = sorted(name for name in found.keys() | room["sources"] if found.get(name) != room["sources"].get(name))
    more = f" and {len(edited) - 1} more" if len(edited) > 1 else ""
    return f"source {digest(found)[:12]}, {EDITED}{edited[0]}{more}"


def read_table() -> dict[str, Room]:
    """Every room by name."""
    return _table(*stamp(TABLE))


@cache
def _table(path: Path, size: int, mtime_ns: int) -> dict[str, Room]:
    return ROOMS.read(path)


def sources(room: Room) -> dict[str, str]:
    """The hash of each file of a room, by its path below the package, as of the last second.

    Raises:
        MachineError: one of its files or folders is not there.
    """
    return _seen(PACKAGE, (*room["holds"],), int(monotonic() / LOOKED_AT_S))


@lru_cache(maxsize=100)
def _seen(package: Path, holds: tuple[str, ...], second: int) -> dict[str, str]:
    return {name: _hash(*stamp(package / name)) for name in _files_below(package, holds)}


def _files_below(package: Path, holds: Iterable[str]) -> Iterator[str]:
    """The files of a room, by their paths below the package."""
    above = len(f"{package}{os.sep}")
    for held in holds:
        if not os.path.exists(path := f"{package}{os.sep}{held}"):
            raise MachineError(f"{path}, of the table of revisions, is not there: install the package again.")
        if os.path.isfile(path):
            yield held
        for folder, _, names in sorted(os.walk(path)):
            files = [one for name in sorted(names) if os.path.isfile(one := f"{folder}{os.sep}{name}")]
            yield from (one[above:] for one in files if not LEFT_OUT.search(one[above:]))


def _is_in(module: str, holds: list[str]) -> bool:
    """Whether a module, or a class as `module:class`, is in one of some files and folders of the package."""
    path = module.partition(":")[0].removeprefix(f"{PACKAGE.name}.").replace(".", "/")
    return any(f"{path}/".startswith(f"{one.removesuffix('.py')}/") for one in holds)


@cache
def _hash(path: Path, size: int, mtime_ns: int) -> str:
    with suppress(SyntaxError, ValueError, RecursionError):  # of a line that is half written
        if path.suffix == ".py":
            return hashlib.sha256(repr(_plain(ast.parse(path.read_bytes()))).encode()).hexdigest()[:16]
    return file_sha256(path)[:16]


def _plain(node: Any) -> Any:
    """A syntax tree as tuples, without docstrings and without what is empty, which other Pythons leave out."""
    if isinstance(node, list):
        return [_plain(one) for one in node if not _is_docstring(one)]
    if not isinstance(node, ast.AST):
        return repr(node)
    named = [(name, value) for name, value in ast.iter_fields(node) if value not in (None, []) and name != "kind"]
    return type(node).__name__, *((name, _plain(value)) for name, value in named)


def _is_docstring(node: Any) -> bool:
    """Whether a node is a text that stands by itself: the docstring of a module, class, function or constant."""
    return isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant) and isinstance(node.value.value, str)


def main(flags: list[str] | None = None) -> None:
    parser = argparse.ArgumentParser(prog="revisions", description="Record what rooms of the package have changed.")
    parser.add_argument("--raise", nargs="+", default=[], dest="raised", metavar="ROOM", help="they make other bytes")
    parser.add_argument("--keep", nargs="+", default=[], metavar="ROOM", help="they make the same bytes as before")
    asked, rooms = parser.parse_args(flags), read_table()
    for name in (*asked.raised, *asked.keep):
        if name not in rooms:
            parser.error(f"there is no room '{name}'; the rooms are: {', '.join(rooms)}")
        room = rooms[name]
        rooms[name] = room | {"revision": room["revision"] + (name in asked.raised), "sources": sources(room)}
    if asked.raised or asked.keep:
        TABLE.write_text(json.dumps(rooms, indent=1) + "\n", encoding="utf-8")
    changed = [name for name, room in rooms.items() if sources(room) != room["sources"]]
    print(f"{plural(len(changed), 'room')} changed and not recorded: {', '.join(changed)}" if changed else "recorded")


if __name__ == "__main__":
    main()
