"""From an action's metres and radians to what ManiSkill executes."""

from collections.abc import Sequence

import numpy as np

from lerobot_constructskill.contract import (
    ACTION_SCALE,
    FULL_ACTION,
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

MANISKILL_CHANNELS = FULL_ACTION
"""The channels of ManiSkill's `pd_ee_delta_pose`, in its order."""


def action_bounds(count: int) -> tuple[np.ndarray, np.ndarray]:
    """The lowest and highest action of `count` channels, the gripper last, (A,) float32 in metres or radians."""
    motion = np.full(count - 1, ACTION_SCALE, dtype=np.float32)
    return np.append(-motion, np.float32(GRIPPER_CLOSED)), np.append(motion, np.float32(GRIPPER_OPEN))


def normalised(actions: np.ndarray, names: Sequence[str]) -> np.ndarray:
    """Actions (..., A) with the channels `names` as ManiSkill takes them, (..., 7), whose range is [-1, 1].

    A channel that is not named is 0, and so is one that is -0.0: both move the robot alike, to the last bit.
    """
    scaled = np.zeros((*actions.shape[:-1], len(MANISKILL_CHANNELS)), dtype=np.float32)
    scale = np.array([CHANNEL_SCALE[name] for name in names], dtype=np.float32)
    scaled[..., [MANISKILL_CHANNELS.index(name) for name in names]] += actions / scale
    return scaled


def within_reach(actions: np.ndarray, names: Sequence[str]) -> np.ndarray:
    """Actions (..., A) as they are executed: as `normalised` gives them, clipped to [-1, 1]."""
    return np.clip(normalised(actions, names), -1, 1)
