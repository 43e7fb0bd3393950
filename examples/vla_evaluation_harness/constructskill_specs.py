"""What an action means here, in the words that vla-evaluation-harness compares before the first episode.

The harness compares formats and lengths, not ranges, and its own "delta_xyz" is from -1 to 1: metres need a format of
their own for a model that sends normalised numbers to be told apart.
"""

from collections.abc import Sequence

from vla_eval.specs import GRIPPER_CLOSE_NEG, DimSpec

from lerobot_constructskill.contract import ACTION_SCALE, GRIPPER_CLOSED, GRIPPER_OPEN, TRANSLATION

REACH = (-ACTION_SCALE, ACTION_SCALE)

POSITION = DimSpec(
    "position", len(TRANSLATION), "delta_xyz_metres", REACH, description="asked for in a step, base frame"
)

CONTINUOUS = "continuous_close_negative"

GRIPPER = DimSpec(
    "gripper",
    1,
    CONTINUOUS,
    (GRIPPER_CLOSED, GRIPPER_OPEN),
    accepts=frozenset({CONTINUOUS, GRIPPER_CLOSE_NEG.format}),
    description="+1 open, -1 closed, in between half open",
)


def rotation(names: Sequence[str], is_radians: bool = True) -> DimSpec:
    """The specification of rotations with these names, such as `dyaw`, in radians or from -1 to 1."""
    unit, reach = ("radians", REACH) if is_radians else ("normalised", (-1, 1))
    return DimSpec("rotation", len(names), f"delta_{'_'.join(names)}_{unit}", reach, description="asked for in a step")
