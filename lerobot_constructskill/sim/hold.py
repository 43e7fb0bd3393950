"""Holds the hand level: a wrist stiffened in the rotations that a task's action does not name.

`pd_ee_delta_pose` is a spring from the current pose, so a hand that is never told its rotation tilts by some 0.006 rad
a step under a held brick. That is the paper's scene; a receptacle with a few millimetres of play needs a level brick.
"""

from dataclasses import dataclass

import torch
from mani_skill.utils.geometry.rotation_conversions import quaternion_invert, quaternion_multiply

from lerobot_constructskill.contract import ACTION_SCALE, ROTATION_SIGN, TRANSLATION

HOLDING = "pd_ee_delta_pose"
"""The control mode whose actions have the channels that are overwritten; others are left to themselves."""

N_TRANSLATION = len(TRANSLATION)


@dataclass(frozen=True)
class Hold:
    """What the scene writes into the rotation channels of an action.

    Args:
        yaw: hold the yaw too; otherwise it stays the action's own.
    """

    yaw: bool

    def apply(self, action: torch.Tensor, hand: torch.Tensor) -> torch.Tensor:
        """`action`, (7,) or (num_envs, 7) as ManiSkill takes it, with the held rotations overwritten.

        Args:
            hand: orientation of the hand, (num_envs, 4) as (w, x, y, z).
        """
        channels = slice(N_TRANSLATION, N_TRANSLATION + (3 if self.yaw else 2))
        held = (self.correction(hand) * ROTATION_SIGN / ACTION_SCALE).clamp(-1, 1)
        action = action.clone()
        action[..., channels] = held[..., : channels.stop - channels.start].reshape(action[..., channels].shape)
        return action

    def correction(self, hand: torch.Tensor) -> torch.Tensor:
        """Small rotation in radians about the world's axes, (num_envs, 3), that lets the hand point down again."""
        level = torch.zeros_like(hand)
        level[:, 1:3] = hand[:, 1:3]  # half a turn about a horizontal axis: straight down, any yaw
        if self.yaw:
            level[:, 1], level[:, 2] = 1.0, 0.0
        level = level / level.norm(dim=-1, keepdim=True)
        error = quaternion_multiply(level, quaternion_invert(hand))
        return 2 * error[:, 1:] * torch.sign(error[:, :1])
