"""Rooms that the calls of a function visit, and climbs: first visits of a room above the one visited first before."""

import ast
import sys
from graphlib import TopologicalSorter

from test_architecture import EVERYWHERE, SOURCES, imports, is_ours, room

BELOW = {room(module): set() for module in SOURCES}
for module, path in SOURCES.items():
    BELOW[room(module)] |= {room(found.target) for found in imports(path) if is_ours(found.target)} - {room(module)}
HEIGHT = {name: height for height, name in enumerate(TopologicalSorter(BELOW).static_order())}
NODES = {module: [*ast.walk(ast.parse(path.read_text()))] for module, path in SOURCES.items()}


def follow(module: str, name: str, entered: dict[tuple[str, str], None]) -> dict[tuple[str, str], None]:
    """Enter a function or class, and whatever it calls, in the order of the source."""
    nodes = NODES[module]
    own = {node.name: node for node in nodes if isinstance(node, ast.FunctionDef | ast.ClassDef)}
    if name in own and (module, name) not in entered:
        froms = [node for node in nodes if isinstance(node, ast.ImportFrom)]
        known = {alias.asname or alias.name: (one.module, alias.name) for one in froms for alias in one.names}
        entered[module, name] = None
        used = [node for node in ast.walk(own[name]) if isinstance(node, ast.Name)]
        for node in sorted(used, key=lambda node: (node.lineno, node.col_offset)):
            found, called = known.get(node.id, (module, node.id))
            if found in SOURCES:
                follow(found, called, entered)
    return entered


def walk(start: str) -> tuple[list[str], int]:
    """The rooms behind `module:function`, in the order of their first visits, and the number of climbs."""
    visited = dict.fromkeys(room(module) for module, _ in follow(*start.split(":"), {}))
    rooms = [name for name in visited if name not in EVERYWHERE]
    return rooms, sum(HEIGHT[one] < HEIGHT[other] for one, other in zip(rooms, rooms[1:], strict=False))


if __name__ == "__main__":
    print(*map(walk, sys.argv[1:]), sep="\n")
