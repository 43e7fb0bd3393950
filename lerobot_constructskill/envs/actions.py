"""From an action's metres and radians to what ManiSkill executes."""

from collections.abc import Sequence

import numpy as np

from lerobot_constructskill.contract import (
    ACTION_SCALE,
    GRIPPER,
    GRIPPER_CLOSED,
    GRIPPER_OPEN,
    ROTATION,
    ROTATION_SIGN,
    TRANSLATION,
)

CHANNEL_SCALE = {
    **dict.fromkeys(TRANSLATION, ACTION_SCALE),
    **dict.fromkeys(ROTATION, ROTATION_SIGN * ACTION_SCALE),
    GRIPPER: 1.0,
}
"""Metres or radians that ManiSkill calls 1.0; divided by, because its reciprocal rounds otherwise and data sets must
replay bit for bit."""

MANISKILL_CHANNELS = tuple(CHANNEL_SCALE)
"""The channels of ManiSkill's `pd_ee_delta_pose`, in its order."""


def action_bounds(count: int) -> tuple[np.ndarray, np.ndarray]:
    """The lowest and highest action of `count` channels, the gripper last, (A,) float32 in metres or radians."""
    motion = np.full(count - 1, ACTION_SCALE, dtype=np.float32)
    return np.append(-motion, np.float32(GRIPPER_CLOSED)), np.append(motion, np.float32(GRIPPER_OPEN))


def normalised(actions: np.ndarray, names: Sequence[str]) -> np.ndarray:
    """Actions (..., A) with the channels `names` in ManiSkill's numbers, whose range is [-1, 1]."""
    return actions / np.array([CHANNEL_SCALE[name] for name in names], dtype=np.float32)


def within_reach(actions: np.ndarray, names: Sequence[str]) -> np.ndarray:
    """Actions (..., A) in ManiSkill's numbers as they are executed: clipped to [-1, 1]."""
    return np.clip(normalised(actions, names), -1, 1)
