"""Brick to bin with the brick's position randomised: one of the extensions that the paper plans."""

from mani_skill.utils.registration import register_env

from lerobot_constructskill.contract import TASKS
from lerobot_constructskill.sim.tasks.brick import BrickToBinEnv


@register_env(TASKS["brick_to_bin_shifted"].env_id, max_episode_steps=TASKS["brick_to_bin_shifted"].horizon)
class BrickToBinShiftedEnv(BrickToBinEnv):
    """
    **Task Description:**
    The paper's brick and bin; the brick does not always stand in the same place.

    **Randomizations:**
    - The brick's centre is uniform within 0.10 m of its nominal place in x and y; its yaw is fixed.

    **Success Conditions:**
    - Those of `PickPlaceEnv`.
    """

    spawn_range = 0.10
