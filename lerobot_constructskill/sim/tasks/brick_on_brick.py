"""Brick on brick, dry: the second course of a wall one brick thick."""

import numpy as np
import sapien
from mani_skill.utils.registration import register_env
from mani_skill.utils.structs import Actor

from lerobot_constructskill.contract import TASKS
from lerobot_constructskill.sim.precise import PreciseEnv
from lerobot_constructskill.sim.tasks.brick import BrickToBinEnv

TOLERANCE = 0.005
"""Metres that the upper brick may stand off the lower one's edges: NHBC's 1.2-S1 allows a joint 5 mm off the mean."""


@register_env(TASKS["brick_on_brick"].env_id, max_episode_steps=TASKS["brick_on_brick"].horizon)
class BrickOnBrickEnv(PreciseEnv, BrickToBinEnv):
    """
    **Task Description:**
    Set the brick on another of its kind that stands on its edge, flush with it.

    **Randomizations:**
    - The brick's centre is uniform within 0.10 m of its nominal place in x and y; its yaw is fixed.

    **Success Conditions:**
    - Those of `PreciseEnv`: flush within 5 mm and 3 degrees.
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

    def _load_bin(self) -> Actor:
        builder = self.scene.create_actor_builder()
        below = -(self.bin_interior[2] + self.object_size[2]) / 2
        self._add_brick(builder, sapien.Pose([0, 0, below]))
        builder.initial_pose = sapien.Pose(p=self.bin_position)
        return builder.build_kinematic(name="bin")
