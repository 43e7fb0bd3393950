"""Scenes with little play: the hand is held level and an object counts as placed only where it was meant to be."""

import numpy as np
import torch

from lerobot_constructskill.sim.actions import Hold
from lerobot_constructskill.sim.scene import PickPlaceEnv

UPRIGHT = np.radians(3.0)
"""Largest tilt in radians from the way the object was carried."""

REST_SPEED = 0.01
"""Speed in m/s below which an object is at rest."""

DEPTH_TOLERANCE = 0.004
"""Largest height in metres above the floor of the receptacle at which an object stands on it."""

PENETRATION = 1e-4
"""Metres that the solver lets bodies into each other."""


class StrictPlaceEnv(PickPlaceEnv):
    """
    **Task Description:**
    Pick-and-place into a receptacle that leaves the object little play.

    **Randomizations:**
    - Those of `PickPlaceEnv`; the yaw is fixed.

    **Success Conditions:**
    - The object's centre is within `play` of the receptacle's middle and at the height at which it stands on the
      floor, the object is as upright and as turned as it should be, at rest, and both fingers are open, for five
      consecutive steps.
    - The paper's own condition is reported beside it, as `is_placed`.
    """

    yaw_range = 0.0
    hold = Hold(yaw=True)

    yaw_tolerance = np.pi / 2
    """Largest angle in radians between the object and the receptacle, which its walls may already see to."""

    @property
    def play(self) -> tuple[float, float]:
        """Largest distance in x and y between the object's and the receptacle's middle, in metres."""
        return tuple((inside - size) / 2 for inside, size in zip(self.bin_interior, self.object_size, strict=True))[:2]

    def _conditions(self) -> dict[str, torch.Tensor]:
        rest, slack = (
            torch.tensor(value, device=self.device) for value in (self.rest_position, (*self.play, DEPTH_TOLERANCE))
        )
        speeds = self.object.linear_velocity.norm(dim=-1, keepdim=True)
        each = fits(self._object_poses(), rest, slack, self.yaw_tolerance, speeds)
        info = super()._conditions() | {name: value[:, 0] for name, value in each.items()}
        is_fit = torch.stack([info["is_gripper_open"], *(info[name] for name in each)]).all(dim=0)
        is_placed_strictly = self._has_lasted("is_placed_strictly", is_fit)
        self._is_placed[:] = is_placed_strictly[:, None]
        return info | {"is_placed_strictly": is_placed_strictly, "success": is_placed_strictly.clone()}


def fits(
    poses: torch.Tensor, rest: torch.Tensor, slack: torch.Tensor, yaw_tolerance: float, speeds: torch.Tensor
) -> dict[str, torch.Tensor]:
    """In which respects objects are where they were meant to be, each (num_envs, placements) booleans.

    Args:
        poses: of the objects, (num_envs, placements, 7).
        rest: where their middles come to rest, (num_envs, placements, 3) or (3,) metres.
        slack: how far they may be off it in x, y and z, (3,) metres.
        yaw_tolerance: largest turn in radians.
        speeds: of the objects, (num_envs, placements) m/s.
    """
    w, x, y, z = poses[..., 3:].unbind(-1)
    tilt = torch.arccos((1 - 2 * (x * x + y * y)).clamp(-1, 1))
    yaw = torch.atan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))
    return {
        "is_inside": ((poses[..., :3] - rest).abs() <= slack + PENETRATION).all(dim=-1),
        "is_upright": tilt <= UPRIGHT,
        "is_aligned": torch.sin(yaw).abs() <= np.sin(yaw_tolerance),
        "is_at_rest": speeds < REST_SPEED,
    }
