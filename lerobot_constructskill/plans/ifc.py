"""Makes a plan of an IFC file: every building element whose box is one of `KINDS` is laid where the model has it."""

import logging
import re
import unicodedata
from collections.abc import Iterator, Sequence
from itertools import chain, count
from pathlib import Path
from typing import Any

import numpy as np

from lerobot_constructskill.errors import InputError, MissingError, one_line, plural, remedy_of
from lerobot_constructskill.plans.plan import KINDS, PLAN, Plan, written

logger = logging.getLogger(__name__)

SAME = 0.006
"""Metres by which an element's edges may differ from those of its kind."""

TOUCHES = 0.006
"""Largest height in metres between an element's underside and the top of what carries it."""

LONGEST = 40
"""Letters of an element's name."""

MOST = 64 << 20
"""Bytes that a file may have."""


def plan_of(path: Path, origin: tuple[float, float] | None = None) -> dict[str, Any]:
    """The plan of an IFC file, as plain values.

    Elements are laid course by course, from the smallest x on. What carries an element is what its box stands on.

    Args:
        path: of the file.
        origin: x and y in metres in the robot's world of the first element's middle; by default as in the model.

    Raises:
        MissingError: there is no such file, or IfcOpenShell is not installed.
        InputError: it is no IFC file, it holds no element of a known kind, or these make no plan.
    """
    boxes = sorted(_boxes(path), key=lambda box: (round(box[2][2], 2), round(box[2][0], 3)))
    if not boxes:
        sizes = "; ".join(f"{name} {_millimetres(kind.size)}" for name, kind in KINDS.items())
        raise InputError(f"'{path}' has no element of a known kind and size ({sizes}).")
    ground = min(middle[2] - size[2] / 2 for _, _, middle, size in boxes)
    moved = np.zeros(2) if origin is None else np.array(origin) - boxes[0][2][:2]
    if (abs(boxes[0][2][:2] + moved) > 1).any():
        x, y = (f"{value:g}" for value in boxes[0][2][:2])
        raise InputError(
            f"The first element, '{boxes[0][0]}', lies at x = {x} m, y = {y} m in '{path}', out of the robot's reach: "
            "say where it is to lie, such as --origin='[-0.4, -0.25]'."
        )
    elements: dict[str, dict[str, Any]] = {}
    for number, (name, kind, middle, size) in enumerate(boxes):
        on = [
            other
            for (other, _, below, its_size) in boxes[:number]
            if abs(middle[2] - size[2] / 2 - below[2] - its_size[2] / 2) < TOUCHES
            and (abs(middle - below)[:2] < (size + its_size)[:2] / 2).all()
        ]
        if not on and middle[2] - size[2] / 2 - ground > TOUCHES:
            raise InputError(f"The element '{name}' in '{path}' hangs in the air: nothing is below it.")
        at = [round(float(value), 4) for value in middle[:2] + moved]
        elements[name] = {"kind": kind, "at": at} | ({"on": on} if on else {})
    facts = {"instruction": "Build the wall.", "elements": elements}
    made: Plan = PLAN.parse(written(facts), f"The plan of '{path}'")
    return {"instruction": made.instruction, "tolerance": made.tolerance, "elements": elements}


def _boxes(path: Path) -> Iterator[tuple[str, str, np.ndarray, np.ndarray]]:
    """Name, kind, middle and size in metres of every element of a known kind."""
    if not path.is_file():
        raise MissingError(f"There is no file '{path}'.")
    if path.stat().st_size > MOST:
        raise InputError(f"'{path}' has more than {MOST:,} bytes.")
    try:
        import ifcopenshell
        import ifcopenshell.geom
        import ifcopenshell.util.shape
        from ifcopenshell import open as read_ifc
    except ModuleNotFoundError as error:
        raise MissingError(remedy_of(error) or str(error)) from error
    try:
        model = read_ifc(str(path))
        parts: Any = model.by_type("IfcElement")
    except (RuntimeError, OSError, AttributeError, ifcopenshell.Error) as error:
        raise InputError(f"'{path}' is not an IFC file ({one_line(error)[:100]}).") from None
    settings = ifcopenshell.geom.settings()
    taken: set[str] = set()
    left_out: list[str] = []
    for part in parts:
        if part.Representation is None:
            continue
        try:
            shape: Any = ifcopenshell.geom.create_shape(settings, part)
        except RuntimeError as error:
            raise InputError(f"The shape of '{part.Name}' in '{path}' cannot be computed ({error}).") from None
        matrix = ifcopenshell.util.shape.get_shape_matrix(shape)
        corners = ifcopenshell.util.shape.get_vertices(shape.geometry)
        if not len(corners):
            continue
        corners = corners @ matrix[:3, :3].T + matrix[:3, 3]
        size, middle = np.ptp(corners, axis=0), (corners.max(axis=0) + corners.min(axis=0)) / 2
        kind = next((name for name, one in KINDS.items() if (abs(size - one.size) < SAME).all()), None)
        if kind is None:
            left_out.append(f"'{part.Name}' ({_millimetres(size)})")
        else:
            plain = unicodedata.normalize("NFKD", part.Name or kind).encode("ascii", "ignore").decode()
            name = re.sub(r"[^A-Za-z0-9]+", "_", plain).strip("_")[:LONGEST] or kind
            free = next(one for one in chain([name], (f"{name}_{n}" for n in count(2))) if one not in taken)
            taken.add(free)
            yield free, kind, middle, size
    if left_out:
        logger.warning(
            "%s of '%s' left out, of no known kind and size: %s%s",
            plural(len(left_out), "element"),
            path,
            ", ".join(left_out[:3]),
            ", ..." * (len(left_out) > 3),
        )


def _millimetres(size: Sequence[float]) -> str:
    return " x ".join(f"{1000 * edge:.0f}" for edge in size) + " mm"
