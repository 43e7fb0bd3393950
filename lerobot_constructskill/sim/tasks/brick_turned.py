"""Brick to bin with the brick turned any way: the jaws must be aligned to it, and the brick to the bin."""

import numpy as np
from mani_skill.utils.registration import register_env

from lerobot_constructskill.contract import TASKS
from lerobot_constructskill.sim.hold import Hold
from lerobot_constructskill.sim.tasks.brick import BrickToBinEnv


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
