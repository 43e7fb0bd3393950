"""Rows of the task table that other installed packages offer by an entry point. Standard library only."""

import logging
from collections.abc import Iterator
from importlib.metadata import entry_points
from multiprocessing import parent_process

from lerobot_constructskill.errors import first_line

GROUP = "lerobot_constructskill.tasks"
"""Entry points of this group name a row of the table, or several of them, as `module:attribute`."""

logger = logging.getLogger(__name__)


def offered[Row](kind: type[Row]) -> Iterator[tuple[str, Row]]:
    """Yield every row that an installed package offers, after the package's name.

    A package whose rows cannot be loaded is skipped with a warning, so that it does not stop other tasks.

    Args:
        kind: the class of a row.
    """
    points = [(point.dist.name if point.dist else point.module, point) for point in entry_points(group=GROUP)]
    for package, point in sorted(points, key=lambda pair: (pair[0], pair[1].name)):
        try:
            found = point.load()
            rows = [found] if isinstance(found, kind) else list(found)
            if strange := [row for row in rows if not isinstance(row, kind)]:
                raise TypeError(f"it holds {strange[0]!r:.100}, not a {kind.__name__}")
        except (Exception, SystemExit) as error:  # whatever the code of another package may raise
            if parent_process() is None:  # workers would repeat it
                fails = f"{point.name} = {point.value} fails ({type(error).__name__}: {first_line(error)})"
                logger.warning("The tasks of the package '%s' are left out: its entry point %s.", package, fails)
            continue
        yield from ((package, row) for row in rows)
