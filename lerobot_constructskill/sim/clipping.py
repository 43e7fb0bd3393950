"""Actions that ask for more than the controller gives are clipped and counted; once a process that is logged."""

import logging
from typing import ClassVar

import torch

from lerobot_constructskill.contract import ACTION_SCALE

LEAST, SHARE = 10, 0.1
"""So many clipped actions of an episode, and more than this share of those so far, are logged."""

logger = logging.getLogger(__name__)


class Clipping:
    """Clips the actions of `num_envs` episodes and counts them, by environment.

    An action counts where a translation or rotation is out of range. A gripper that is asked to open wider than wide
    loses nothing by it, and its controller clips it.
    """

    has_told: ClassVar[bool] = False

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
        if not Clipping.has_told:
            self._tell(before + 1)
        return action.clamp(-1, 1)

    def _tell(self, taken: torch.Tensor) -> None:
        worst = int(self.steps.argmax())
        clipped, steps = int(self.steps[worst]), int(taken[worst])
        if clipped < LEAST or clipped <= SHARE * steps:
            return
        Clipping.has_told = True
        logger.warning(
            "%d of the first %d actions of an episode asked for more than %g m or rad and were clipped. "
            "--env.type=constructskill takes metres and radians per step, not -1 to 1 (`env.contract` says units and "
            "ranges); ManiSkill's ids take -1 to 1, where 1 is %g m or rad.",
            *(clipped, steps, ACTION_SCALE, ACTION_SCALE),
        )
