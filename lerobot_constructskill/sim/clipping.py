"""Clips and counts actions that ask for more than the controller gives, and warns of them once a process."""

import logging
from typing import ClassVar

import torch

from lerobot_constructskill.contract import ACTION_SCALE

LEAST, SHARE = 10, 0.1
"""An episode with at least so many clipped actions, and more than this share of all so far, is warned of."""

logger = logging.getLogger(__name__)


class Clipping:
    """Clips the actions of `num_envs` episodes and counts them, by environment.

    An action counts where a translation or rotation is out of range. A gripper that is asked to open wider than wide
    loses nothing by it, and its controller clips it.
    """

    has_warned: ClassVar[bool] = False

    def __init__(self, num_envs: int, device: torch.device):
        self.steps = torch.zeros(num_envs, dtype=torch.int32, device=device)

    def apply(self, action: torch.Tensor, before: torch.Tensor) -> torch.Tensor:
        """`action`, (7,) or (num_envs, 7) of ManiSkill's normalised numbers, its motion within [-1, 1].

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
