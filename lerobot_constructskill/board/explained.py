"""What a stranger needs to read the board: what a column means, how its task looks, and how wide an interval is."""

from base64 import b64encode
from pathlib import Path

from markupsafe import Markup

from lerobot_constructskill.analysis.stats.intervals import Estimate
from lerobot_constructskill.board.entries import Laid
from lerobot_constructskill.board.protocol import BoardSetting
from lerobot_constructskill.contract import get_task
from lerobot_constructskill.perturbations import AXES, Perturbation

TASK_PICTURES = Path(__file__).parents[2] / "examples" / "pictures"
"""Pictures of the tasks, by their names; beside the package in a checkout, and nowhere else."""

MEANINGS = {
    "brick_to_bin": "A brick, always from the same place, into a bin of 0.25 x 0.20 x 0.15 m.",
    "brick_to_bin_shifted": "The same brick from another place every time, into the same bin.",
    "block_to_bin": "A concrete block from another place every time, into a wider bin on the other side.",
    "brick_to_bin_40mm": "A brick into a shallow bin that is 40 mm longer and wider than it.",
    "brick_to_bin_20mm": "The bin is 20 mm longer and wider than the brick.",
    "brick_to_bin_10mm": "The bin is 10 mm longer and wider than the brick.",
    "brick_to_bin_5mm": "The bin is 5 mm longer and wider than the brick.",
    "brick_to_bin_3mm": "The bin is 3 mm longer and wider than the brick.",
    "brick_to_bin_turned": "A brick from another place, turned otherwise every time, into the bin.",
    "brick_on_brick": "A brick on top of another one, flush within 5 mm and 3 degrees.",
    "tile_to_grid": "A ceiling tile, held by a lifter, into an opening of the grid that is 5 mm longer and wider.",
    "tenon_to_mortise": "A timber post, its tenon into the mortise of a sill that is 4 mm longer and wider.",
    "brick_to_grey": "Told so, the brick into the grey bin; a block and a blue bin are there too.",
    "brick_to_blue": "The same scene; told so, the brick into the blue bin.",
    "block_to_grey": "The same scene; told so, the block into the grey bin.",
    "block_to_blue": "The same scene; told so, the block into the blue bin.",
    "course_of_three": "Three bricks end to end, with joints of 10 mm.",
    "bond_of_five": "Three bricks end to end, and two on them that bridge the joints.",
    "lintel_on_posts": "A beam onto two posts that the robot sets first, level.",
}
"""Of each task on the board."""


def meaning(setting: BoardSetting) -> str:
    """What is done in a setting, in a sentence, and what is changed there."""
    perturbation = Perturbation(setting.perturb, setting.perturb_seed)
    changed = [f"{axis} ({AXES[axis].unit}: {amount:g})" for axis in AXES if (amount := perturbation.amount(axis))]
    if changed:
        return f"As {setting.task}, with another {', and another '.join(changed)}."
    return MEANINGS.get(setting.task, get_task(setting.task).instruction)


def picture(task: str) -> Markup | None:
    """A task's picture as an element that holds it; None where there is none."""
    file = TASK_PICTURES / f"{task}.jpg"
    if not file.is_file():
        return None
    data = b64encode(file.read_bytes()).decode()
    said = Markup("{}: the policy's view at the start; the expert half-way and at the end").format(task)
    return Markup('<img alt="{}" src="data:image/jpeg;base64,{}">').format(said, data)


def drawn(estimate: Estimate, has_interval: bool) -> Markup:
    """A share as a point on a line from 0 to 100 %, with its interval as a bar."""
    low, value, high = (100 * getattr(estimate, name) for name in ("low", "value", "high"))
    bar = f'<path class="bar" d="M{low:.1f} 4H{high:.1f}"/>' if has_interval else ""
    return Markup(
        '<svg class="interval" viewBox="-3 0 106 8" aria-hidden="true"><path class="axis" d="M0 4H100M0 2V6M100 2V6"/>'
        f'{bar}<circle cx="{value:.1f}" cy="4" r="3"/></svg>'
    )


def laid(of: Laid, has_range: bool) -> str:
    """What was laid of a plan, in a line, with the range over seeds where there are several."""
    seeds = f" ({of.chain.low:.2f} to {of.chain.high:.2f})" if has_range else ""
    counts = [f"{count} {name}" for name in ("drops", "knocks", "collisions") if (count := getattr(of, name))]
    told = f"chain {of.chain.value:.2f} of {of.elements}{seeds}, {100 * of.share.value:.3g} % in place"
    return ", ".join([told, *counts])
