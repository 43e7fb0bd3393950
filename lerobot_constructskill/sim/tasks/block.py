"""Concrete block to bin: the extension promise, one asset, four geometry constants and its initial states."""

from collections.abc import Sequence

from mani_skill.utils.building import ActorBuilder
from mani_skill.utils.registration import register_env

from lerobot_constructskill.contract import TASKS
from lerobot_constructskill.sim.scene import PickPlaceEnv
from lerobot_constructskill.sim.visuals import mottled

AERATED_CONCRETE_DENSITY = 600.0
"""kg/m3, autoclaved aerated concrete."""

BLOCK = (0.12, 0.06, 0.08)
"""Size of the block in metres."""


@register_env(TASKS["block_to_bin"].env_id, max_episode_steps=TASKS["block_to_bin"].horizon)
class BlockToBinEnv(PickPlaceEnv):
    """
    **Task Description:**
    Put a small aerated-concrete block into a wider bin at the robot's other side.

    **Randomizations:**
    - The block's centre is uniform within 0.05 m of its nominal place in x and y; its yaw is fixed.

    **Success Conditions:**
    - Those of `PickPlaceEnv`.
    """

    object_size = BLOCK
    object_center = (0.02, 0.0)
    bin_center = (-0.05, 0.35)
    bin_interior = (0.30, 0.22, 0.12)

    spawn_range = 0.05
    yaw_range = 0.0

    def _load_object(self, builder: ActorBuilder) -> None:
        add_block(self, builder, self.object_size)


def add_block(env: PickPlaceEnv, builder: ActorBuilder, size: Sequence[float]) -> None:
    """Add a block to an actor, its middle at the actor's origin.

    Args:
        size: edges in metres, (3,).
    """
    concrete = mottled((196, 194, 188), contrast=0.08)
    env._add_box(builder, [0, 0, 0], size, concrete, AERATED_CONCRETE_DENSITY)
