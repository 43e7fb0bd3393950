"""Measures a laid wall as a mason does: every element against its place, and the courses in length, level and line."""

import json
from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np

from lerobot_constructskill.plans.plan import Plan

SAME_COURSE = 0.02
"""Difference in planned height and across the wall, in metres, up to which elements of one kind are of one course."""


def measure(plan: Plan, sim: Mapping[str, np.ndarray]) -> dict[str, Any]:
    """How the elements lie, in mm and degrees.

    Args:
        sim: the privileged state, as `contract.SIM_STATE` names it.

    Returns:
        errors: of each element in the plan's order, off its place in x, y and z (mm), tilt and turn (degrees).
        length: of the longest course that is placed whole, less its planned length, mm.
        level: largest difference between the tops of one placed course, mm.
        line: largest distance of a placed element from the plan's line, across the wall, mm.
        The last three are None where nothing is placed that they could be taken of.
    """
    count = len(plan.elements)
    poses, sizes = sim["object_poses"].reshape(-1, 7)[:count], sim["object_sizes"].reshape(-1, 3)[:count]
    places, interiors = sim["bin_positions"].reshape(-1, 3)[:count], sim["bin_interiors"].reshape(-1, 3)[:count]
    is_placed, drawn = sim["is_placed"][:count] > 0, np.array(plan.drawn, dtype=float)
    resting = places + np.array([0, 0, 1]) * (sizes - interiors) / 2
    w, x, y, z = poses[:, 3:].T.astype(float)
    tilts = np.arccos(np.clip(1 - 2 * (x * x + y * y), -1, 1))
    turns = np.arctan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))
    errors = np.column_stack([1000 * (poses[:, :3] - resting), np.degrees(tilts), np.degrees(turns)])
    tops = poses[:, 2] + sizes[:, 2] / 2
    courses = list(_courses(plan, drawn))
    whole = [course for course in courses if is_placed[course].all() and course.sum() > 1]
    nominal = np.array([kind.size for kind in plan.kinds])
    lengths = [(_length(drawn[one], nominal[one]), _length(poses[one], sizes[one])) for one in whole]
    planned, built = max(lengths, default=(None, None))
    levels = [np.ptp(tops[course & is_placed]) for course in courses if (course & is_placed).sum() > 1]
    lines = abs(poses[is_placed, 1] - drawn[is_placed, 1])
    return {
        "errors": errors.round(2).tolist(),
        "length": None if planned is None or built is None else round(1000 * float(built - planned), 2),
        "level": round(1000 * float(max(levels)), 2) if levels else None,
        "line": round(1000 * float(lines.max()), 2) if len(lines) else None,
    }


def _courses(plan: Plan, drawn: np.ndarray) -> Iterator[np.ndarray]:
    """Which elements are of each course, (elements,) bool."""
    kinds, seen = np.array([element.kind for element in plan.elements.values()]), np.zeros(len(drawn), dtype=bool)
    for number, middle in enumerate(drawn):
        if not seen[number]:
            course = (abs(drawn - middle)[:, 1:] < SAME_COURSE).all(axis=1) & (kinds == kinds[number])
            seen |= course
            yield course


def _length(middles: np.ndarray, sizes: np.ndarray) -> float:
    """Of a course from end to end, in metres."""
    ends = [middles[:, 0] + side * sizes[:, 0] / 2 for side in (-1, 1)]
    return float(ends[1].max() - ends[0].min())


def measured(plan: Plan, sim: Mapping[str, np.ndarray]) -> str:
    """The same as JSON."""
    return json.dumps(measure(plan, sim))
