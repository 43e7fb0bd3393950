"""Finds what has changed since a node was made: names of packages and rooms, places of settings."""

from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from lerobot_constructskill.artifacts.code import code_of, modules_of
from lerobot_constructskill.artifacts.digests import installed
from lerobot_constructskill.artifacts.revisions import EDITED, PREFIX, read_table, revision
from lerobot_constructskill.artifacts.store import INPUTS, LINEAGE, SPEC, SPECIFICATION, VERSIONS, Node
from lerobot_constructskill.errors import MissingError


def differences(before: Mapping[str, Any], node: Node) -> list[str]:
    """What differs between a node, with its inputs, and a node that was made before.

    Args:
        before: the specification of the node that was made, with its lineage.
    """
    return list(dict.fromkeys(_differences(before, node.spec, before.get(LINEAGE, {}), node.lineage)))


def _differences(before: Mapping, now: Mapping, then: Mapping, lineage: Mapping, place: str = "") -> Iterator[str]:
    yield from _told(_own(before), _own(now), place)
    known = before.get(INPUTS, {})
    for name, digest in now.get(INPUTS, {}).items():
        if known.get(name) != digest:
            made, inside = then.get(known.get(name)), f"{place}.{name}".lstrip(".")
            yield from _differences(made, lineage[digest], then, lineage, inside) if made else [inside]


def _own(spec: Mapping[str, Any]) -> dict[str, Any]:
    return {key: value for key, value in spec.items() if key not in (INPUTS, LINEAGE)}


def _told(before: Any, now: Any, place: str) -> Iterator[str]:
    if not (isinstance(before, Mapping) and isinstance(now, Mapping)):
        if before != now:
            edited = now.partition(EDITED)[2] if isinstance(now, str) else ""
            yield f"{place} ({edited})" if edited else place
        return
    for key in dict.fromkeys([*now, *before]):
        inner = key if place.split(".")[-1] == VERSIONS else f"{place}.{key}".lstrip(".")
        yield from _told(before.get(key), now.get(key), inner)


def versions_that_differ(before: Mapping[str, str], now: Mapping[str, str | None]) -> list[str]:
    """The packages and rooms whose versions differ; an edited room with its file."""
    return list(_told({name: before.get(name) for name in now}, now, VERSIONS))


def outdated(folder: Path) -> list[str]:
    """The packages and rooms that have changed since a folder of a store, or one of its inputs, was made.

    Raises:
        MissingError: there is no such folder, or it is not a folder of a store.
        InputError: its specification is damaged.
    """
    if not (folder / SPEC).exists():
        raise MissingError(f"'{folder}' is no folder of a store: it has no {SPEC}.")
    spec = SPECIFICATION.read(folder / SPEC)
    before = dict(pair for one in (spec, *spec.get(LINEAGE, {}).values()) for pair in one[VERSIONS].items())
    return versions_that_differ(before, {name: _code_now(name, told) for name, told in before.items()})


def _code_now(name: str, before: str) -> str | None:
    """The revision of a room, the version of a package, or its version and source where these were told before."""
    if name.startswith(PREFIX):
        room = read_table().get(name.removeprefix(PREFIX))
        return room and revision(room)
    if "source " not in before:
        return installed(name)
    return code_of(*modules_of(name)).get(name)
