"""The tasks with the paper's brick: into its bin, shifted, turned, into ever tighter bins, and on another brick."""

from collections.abc import Sequence

import numpy as np
import sapien
from mani_skill.utils.building import ActorBuilder
from mani_skill.utils.registration import register_env

from lerobot_constructskill.contract import LADDER, TASKS
from lerobot_constructskill.sim.actions import Hold
from lerobot_constructskill.sim.perturb import check_fits
from lerobot_constructskill.sim.scene import PickPlaceEnv
from lerobot_constructskill.sim.strict import StrictPlaceEnv
from lerobot_constructskill.sim.visuals import mottled, perforated, textured

CLAY_DENSITY = 1000.0
"""kg/m3, a declared constant: ManiSkill's default, below a solid clay brick's 1,800."""

CLAY_RED = (158, 70, 48)

SKIN = 0.0005
"""Metres; visual only."""

LADDER_DEPTH = 0.05
"""Depth of the ladder's bins in metres; the tips of the fingers end 0.039 m below the top of the 0.10 m high brick."""

TOLERANCE = 0.005
"""Metres that the upper brick may stand off the lower one's edges, as NHBC's 1.2-S1(b) lets a bed joint be off."""


@register_env(TASKS["brick_to_bin"].env_id, max_episode_steps=TASKS["brick_to_bin"].horizon)
class BrickToBinEnv(PickPlaceEnv):
    """
    **Task Description:**
    Put a 0.21 x 0.10 x 0.065 m brick (Waaldickformat) into a bin of interior 0.25 x 0.20 x 0.15 m. The brick
    stands on its long narrow face, because only its 0.065 m face pair fits the Panda's jaws.

    **Randomizations:**
    - None: the paper fixes the brick's pose.

    **Success Conditions:**
    - Those of `PickPlaceEnv`.
    """

    spawn_range = 0.0
    yaw_range = 0.0
    is_brick = True

    def _load_object(self, builder: ActorBuilder) -> None:
        self._add_brick(builder, 0.0)

    def _add_brick(self, builder: ActorBuilder, height: float) -> None:
        add_brick(self, builder, height, self.object_size)


def add_brick(env: PickPlaceEnv, builder: ActorBuilder, height: float, size: Sequence[float]) -> None:
    """Add a brick to an actor.

    Args:
        height: of its middle over the actor's origin, in metres.
        size: edges in metres, (3,).
    """
    x, y, z = np.array(size) / 2
    colour, pattern = env.draws.surface("brick", CLAY_RED, 0)
    clay = mottled(colour, contrast=0.12, size=512, seed=pattern)
    env._add_box(builder, [0, 0, height], size, clay, CLAY_DENSITY)
    if env.scene.can_render():
        # SAPIEN unfolds a box on its texture as a cross of 3 x 4 faces: 2 x 5 holes a face.
        bed = perforated(clay, rows=3 * 2, columns=4 * 5, radius=0.28)
        for side in (-1, 1):  # a skin on each bed face shows the perforations
            builder.add_box_visual(sapien.Pose([0, side * y, height]), [x, SKIN, z], material=textured(bed))


@register_env(TASKS["brick_to_bin_shifted"].env_id, max_episode_steps=TASKS["brick_to_bin_shifted"].horizon)
class BrickToBinShiftedEnv(BrickToBinEnv):
    """
    **Task Description:**
    The paper's brick and bin; the brick does not always stand in the same place. The paper plans this extension.

    **Randomizations:**
    - The brick's centre is uniform within 0.10 m of its nominal place in x and y; its yaw is fixed.

    **Success Conditions:**
    - Those of `PickPlaceEnv`.
    """

    spawn_range = 0.10


@register_env(TASKS["brick_to_bin_turned"].env_id, max_episode_steps=TASKS["brick_to_bin_turned"].horizon)
class BrickToBinTurnedEnv(BrickToBinEnv):
    """
    **Task Description:**
    The paper's brick and bin, with the brick's whole pose randomised. The yaw of the hand belongs to the action, its
    roll and pitch are held.

    **Randomizations:**
    - The brick's centre is uniform within 0.10 m of its nominal place in x and y, its yaw over a full turn.

    **Success Conditions:**
    - Those of `PickPlaceEnv`.
    """

    spawn_range = 0.10
    yaw_range = np.pi
    hold = Hold(yaw=False)


class BrickLadderEnv(StrictPlaceEnv, BrickToBinEnv):
    """
    **Task Description:**
    Put the paper's brick into a bin that leaves it a total clearance of 40, 20, 10, 5 or 3 mm in both x and y. The bin
    is shallow: when the brick is on its floor, the fingers that release it open above the rim.

    **Randomizations:**
    - The brick's centre is uniform within 0.10 m of its nominal place in x and y; its yaw is fixed.

    **Success Conditions:**
    - Those of `StrictPlaceEnv`.

    Args:
        clearance: how much wider and longer the bin is than the brick, in metres; each registered id has its own.

    Raises:
        InputError: the perturbation draws a brick that does not fit.
    """

    spawn_range = 0.10

    def __init__(self, *args, clearance: float = max(LADDER.values()), **kwargs):
        x, y, _ = self.object_size
        self.bin_interior = (x + clearance, y + clearance, LADDER_DEPTH)
        super().__init__(*args, **kwargs)
        check_fits(self.object_size, clearance)


for _name, _clearance in LADDER.items():
    register_env(TASKS[_name].env_id, max_episode_steps=TASKS[_name].horizon, clearance=_clearance)(BrickLadderEnv)


@register_env(TASKS["brick_on_brick"].env_id, max_episode_steps=TASKS["brick_on_brick"].horizon)
class BrickOnBrickEnv(StrictPlaceEnv, BrickToBinEnv):
    """
    **Task Description:**
    Set the brick on another of its kind that stands on its edge, flush with it: the second course of a wall, dry.

    **Randomizations:**
    - The brick's centre is uniform within 0.10 m of its nominal place in x and y; its yaw is fixed.

    **Success Conditions:**
    - Those of `StrictPlaceEnv`: flush within 5 mm and 3 degrees.
    """

    spawn_range = 0.10
    yaw_tolerance = np.radians(3.0)

    # Both bricks are of one size, which a perturbation can draw.
    @property
    def bin_floor(self) -> float:
        return self.object_size[2]

    @property
    def bin_interior(self) -> tuple[float, float, float]:
        return (self.object_size[0] + 2 * TOLERANCE, self.object_size[1] + 2 * TOLERANCE, 0.04)

    def _load_bin(self, builder: ActorBuilder) -> None:
        self._add_brick(builder, -(self.bin_interior[2] + self.object_size[2]) / 2)
