"""The tolerance ladder: the shifted brick into ever tighter bins."""

from mani_skill.utils.registration import register_env

from lerobot_constructskill.contract import LADDER, TASKS
from lerobot_constructskill.sim.perturb import check_fits
from lerobot_constructskill.sim.precise import PreciseEnv
from lerobot_constructskill.sim.tasks.brick import BrickToBinEnv

BIN_DEPTH = 0.05
"""Metres; the tips of the fingers end 0.039 m below the top of the 0.10 m high brick."""


class BrickLadderEnv(PreciseEnv, BrickToBinEnv):
    """
    **Task Description:**
    Put the paper's brick into a bin that leaves it a total clearance of 40, 20, 10, 5 or 3 mm in both x and y. The bin
    is shallow: when the brick is on its floor, the fingers that release it open above the rim.

    **Randomizations:**
    - The brick's centre is uniform within 0.10 m of its nominal place in x and y; its yaw is fixed.

    **Success Conditions:**
    - Those of `PreciseEnv`.

    Args:
        clearance: how much wider and longer the bin is than the brick, in metres; each registered id has its own.

    Raises:
        InputError: the perturbation draws a brick that does not fit.
    """

    spawn_range = 0.10

    def __init__(self, *args, clearance: float = max(LADDER.values()), **kwargs):
        x, y, _ = self.object_size
        self.bin_interior = (x + clearance, y + clearance, BIN_DEPTH)
        super().__init__(*args, **kwargs)
        check_fits(self.object_size, clearance)


for _name, _clearance in LADDER.items():
    register_env(TASKS[_name].env_id, max_episode_steps=TASKS[_name].horizon, clearance=_clearance)(BrickLadderEnv)
