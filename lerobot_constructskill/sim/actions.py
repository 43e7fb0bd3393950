"""What the scene does to an action: clips and counts what the controller cannot give, delays it, holds the hand level.

`pd_ee_delta_pose` is a spring from the current pose, so a hand that is never told its rotation tilts by some 0.006 rad
a step under a held brick. That is the paper's scene. A receptacle with a few millimetres of play needs a level brick:
its scene stiffens the wrist in the rotations that the task's action does not name.
"""

import logging
from dataclasses import dataclass
from typing import ClassVar

import torch
from mani_skill.utils.geometry.rotation_conversions import quaternion_invert, quaternion_multiply

from lerobot_constructskill.contract import ACTION_SCALE, GRIPPER_OPEN, ROTATION, ROTATION_SIGN, TRANSLATION

LEAST, SHARE = 10, 0.1
"""An episode with at least so many clipped actions, and more than this share of all so far, is warned of."""

N_TRANSLATION, N_MOTION = len(TRANSLATION), len(TRANSLATION) + len(ROTATION)

logger = logging.getLogger(__name__)


class Clipping:
    """Clips the actions of `num_envs` episodes, counts the clipped ones by environment, and warns once a process.

    An action counts where a translation or rotation is out of range. The gripper's channel is not counted: its
    controller clips it, and no motion is lost.
    """

    has_warned: ClassVar[bool] = False

    def __init__(self, num_envs: int, device: torch.device):
        self.steps = torch.zeros(num_envs, dtype=torch.int32, device=device)

    def apply(self, action: torch.Tensor, before: torch.Tensor) -> torch.Tensor:
        """Return `action`, (7,) or (num_envs, 7) in ManiSkill's numbers, with its motion clipped to [-1, 1].

        Args:
            before: steps that the episodes have taken before this one, (num_envs,).
        """
        is_beyond = (action[..., :-1].abs() > 1).any(dim=-1)
        if not is_beyond.any():
            return action
        self.steps += is_beyond
        worst = int(self.steps.argmax())
        clipped, steps = int(self.steps[worst]), int(before[worst]) + 1
        if not Clipping.has_warned and clipped >= LEAST and clipped > SHARE * steps:
            Clipping.has_warned = True
            logger.warning(
                "%d of the first %d actions of an episode asked for more than %g m or rad and were clipped. "
                "--env.type=constructskill takes metres and radians per step, not -1 to 1 (`env.contract` says units "
                "and ranges); ManiSkill's ids take -1 to 1, where 1 is %g m or rad.",
                *(clipped, steps, ACTION_SCALE, ACTION_SCALE),
            )
        return action.clamp(-1, 1)


class Delay:
    """Executes the actions of `num_envs` episodes `steps` steps late; until then the hand stays, its gripper open."""

    def __init__(self, num_envs: int, device: torch.device, steps: int):
        self._rest = torch.tensor([0.0] * N_MOTION + [GRIPPER_OPEN], device=device)
        self._waiting = self._rest.expand(steps, num_envs, -1).clone()

    def apply(self, action: torch.Tensor) -> torch.Tensor:
        """Take `action`, (7,) or (num_envs, 7), and return the one that is due, of its shape."""
        if not len(self._waiting):
            return action
        given = action.expand_as(self._waiting[0]).to(self._rest.dtype)
        due, self._waiting = self._waiting[0], torch.stack([*self._waiting[1:], given])
        return due.reshape(action.shape)

    def forget(self, env_idx: torch.Tensor) -> None:
        """Begin the episodes of these environments."""
        self._waiting[:, env_idx] = self._rest


HOLDING = "pd_ee_delta_pose"
"""The control mode whose actions are clipped, delayed and held; actions of other modes are left as they are."""


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
