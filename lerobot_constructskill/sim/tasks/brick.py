"""Brick to bin: the paper's task."""

import numpy as np
import sapien
from mani_skill.utils.building import ActorBuilder
from mani_skill.utils.registration import register_env

from lerobot_constructskill.contract import TASKS
from lerobot_constructskill.sim.scene import PickPlaceEnv
from lerobot_constructskill.sim.visuals import mottled, perforated, textured

CLAY_DENSITY = 1000.0
"""kg/m3, a declared constant: ManiSkill's default, below a solid clay brick's 1,800."""

CLAY_RED = (158, 70, 48)

SKIN = 0.0005
"""Metres; visual only."""


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
        self._add_brick(builder, sapien.Pose())

    def _add_brick(self, builder: ActorBuilder, pose: sapien.Pose) -> None:
        x, y, z = half_size = np.array(self.object_size) / 2
        builder.add_box_collision(pose, half_size, density=CLAY_DENSITY)
        if self.scene.can_render():
            colour, pattern = self.draws.surface("brick", CLAY_RED, 0)
            clay = mottled(colour, contrast=0.12, size=512, seed=pattern)
            # SAPIEN unfolds a box on its texture as a cross of 3 x 4 faces: 2 x 5 holes a face.
            bed = perforated(clay, rows=3 * 2, columns=4 * 5, radius=0.28)
            builder.add_box_visual(pose, half_size, material=textured(clay))
            for side in (-1, 1):  # a skin on each bed face shows the perforations
                skin = pose * sapien.Pose([0, side * y, 0])
                builder.add_box_visual(skin, [x, SKIN, z], material=textured(bed))
