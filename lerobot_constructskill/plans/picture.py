"""Draws a plan: from above with the robot and what waits, and from the side."""

from pathlib import Path

from matplotlib.figure import Figure
from matplotlib.patches import Circle, Rectangle

from lerobot_constructskill.contract import ROBOT_BASE
from lerobot_constructskill.plans.check import FARTHEST, NEAREST
from lerobot_constructskill.plans.plan import Kind, Plan, Position, supplies

COLOURS = {"brick": "#b5573a", "post": "#d2a86e", "beam": "#d2a86e"}
WAITING = {"facecolor": "none", "edgecolor": "#888888", "linestyle": ":"}


def draw_plan(plan: Plan, title: str, path: Path) -> None:
    """Write the picture of a plan.

    Raises:
        OSError: the file cannot be written.
    """
    figure = Figure(figsize=(8, 9), layout="constrained")
    above, side = figure.subplots(2, 1, height_ratios=(3, 1))
    for radius in (NEAREST, FARTHEST):
        above.add_patch(Circle(ROBOT_BASE[:2], radius, fill=False, color="#0072b2", linewidth=0.8, linestyle="--"))
    above.plot(*ROBOT_BASE[:2], marker="+", color="#0072b2")
    said = "robot, and how near\nand how far it lays"
    above.annotate(said, ROBOT_BASE[:2], (-8, 0), textcoords="offset points", fontsize=8, ha="right", va="center")
    for number, (name, element) in enumerate(plan.elements.items()):
        place, kind = plan.drawn[number], plan.kinds[number]
        look = {"facecolor": COLOURS.get(element.kind, "#cccccc"), "edgecolor": "black", "linewidth": 0.7}
        for axes, (across, up) in ((above, (0, 1)), (side, (0, 2))):
            axes.add_patch(_outline(place, kind, across, up, **look))
        side.annotate(f"{number + 1} {name}", (place[0], place[2]), ha="center", va="center", fontsize=7)
    for number, (start, kind) in enumerate(zip(supplies(plan), plan.kinds, strict=True)):
        above.add_patch(_outline((*start, 0.0), kind, 0, 1, **WAITING))
        above.annotate(f"{number + 1}", start, ha="center", va="center", fontsize=7, color="#888888")
    above.set(xlabel="x (m)", ylabel="y (m)")
    tolerance = f"tolerance {1000 * plan.tolerance:g} mm" + f" ({plan.standard})" * bool(plan.standard)
    above.set_title(f"{title}: {plan.instruction}\n{tolerance}", fontsize=10)
    side.set(xlabel="x (m)", ylabel="z (m)")
    side.axhline(0, color="black", linewidth=0.8)
    above.set(xlim=(-1.1, 0.3), ylim=(-0.65, 0.7), aspect="equal")
    side.autoscale_view()
    side.set_aspect("equal", adjustable="datalim")
    figure.savefig(path, dpi=130)


def _outline(place: Position, kind: Kind, across: int, up: int, **look) -> Rectangle:
    corner = [place[axis] - kind.size[axis] / 2 for axis in (across, up)]
    return Rectangle((corner[0], corner[1]), kind.size[across], kind.size[up], **look)
