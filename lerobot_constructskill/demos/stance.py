"""How an object stands to the jaws and to the bin, read off a state. Lengths in metres, angles in radians."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from lerobot_constructskill.demos.expert import PrivilegedState

JAW = 0.08
"""How far the Panda's jaws open."""

PAD = 0.02
"""Width of a finger, across the jaws."""

FINGERS_REACH, HAND_REACH, HAND_HEIGHT = 0.06, 0.105, 0.055
"""Along the jaws from the TCP: an open finger's outside, and the hand's, which starts so far above the TCP."""

TIPPED = np.radians(10)
"""Tilt from which on an object does not stand any more."""

TILTED, ROLLED = 0.7, 0.2
"""Angles of a hand that is not told its rotation and has been bent by a collision: from straight down, and of the jaws
from level, at which it does not get around an object any more."""

SLIT, OPENED = 0.004, 0.036
"""Between these positions of both fingers there is something between them."""

GROUNDED = 0.015
"""Height of an object's lowest corner below which it still lies on something."""

MARGIN = 0.01
"""How far outside an object the TCP may be whose fingers hold it; also the walls of a bin, and some."""


@dataclass(frozen=True)
class Stance:
    """An object, a hand and a bin."""

    state: PrivilegedState

    @cached_property
    def rotation(self) -> np.ndarray:
        """The object's, (3, 3): its axes in the world, one a column."""
        w, x, y, z = self.state.object_pose[3:].astype(float)
        return np.array(
            [
                [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
                [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
                [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
            ]
        )

    @property
    def stands(self) -> bool:
        """Whether it stands as it was put there, not tipped over and not upside down."""
        return bool(self.rotation[2, 2] > np.cos(TIPPED))

    @property
    def underside(self) -> float:
        """Height of its lowest corner."""
        return float(self.state.object_pose[2] - abs(self.rotation[2]) @ self.state.object_size / 2)

    @property
    def top(self) -> float:
        """Height of its highest corner."""
        return float(self.state.object_pose[2] + abs(self.rotation[2]) @ self.state.object_size / 2)

    @property
    def rim(self) -> float:
        return float(self.state.rim)

    @property
    def width(self) -> float:
        """What goes between the jaws; an object wider than they open has a handle, of half of that at most."""
        own = float(self.state.object_size[1])
        return own if own < JAW else JAW / 2

    @property
    def skew(self) -> float:
        """Angle between the jaws and the object's faces that they are to take."""
        return float(np.arccos(np.clip(abs(self.rotation[:, 1] @ self.state.jaw_axis), 0, 1)))

    def play(self, skew: float) -> float:
        """How far the jaws may be off the object's middle, on either side, below zero where they do not fit."""
        return float((JAW - self.width / np.cos(skew) - PAD * np.tan(skew)) / 2)

    @property
    def is_bent(self) -> bool:
        """Whether the hand points where it cannot take anything."""
        x, y = self.state.tcp_pose[4:6].astype(float)
        down = 2 * (x * x + y * y) - 1
        return bool(down < np.cos(TILTED) or abs(self.state.jaw_axis[2]) > np.sin(ROLLED))

    @property
    def is_open(self) -> bool:
        return bool(min(self.state.fingers) > OPENED)

    @property
    def is_held(self) -> bool:
        """Whether something is between the fingers and the point between them is in the object."""
        fingers = self.state.fingers
        local = abs(self.rotation.T @ (self.state.tcp - self.state.object_pose[:3]))
        inside = (local < self.state.object_size / 2 + MARGIN).all()
        return bool(inside and max(fingers) <= OPENED and min(fingers) >= SLIT)

    def is_blocked(self, grasp: np.ndarray) -> bool:
        """Whether a wall of the bin is where a finger or the hand would be at the point `grasp`, (3,)."""
        for reach, height in ((FINGERS_REACH, grasp[2]), (HAND_REACH, grasp[2] + HAND_HEIGHT)):
            ends = (grasp[:2] + side * reach * self.state.jaw_axis[:2] for side in (-1, 1))
            if height < self.rim and any(self._is_over_bin(end) for end in ends):
                return True
        return False

    def crosses_bin(self, target: np.ndarray) -> bool:
        """Whether a hand that goes straight to `target` comes over the bin."""
        ways = np.linspace(self.state.tcp[:2], target[:2], 9)
        sides = self.state.jaw_axis[:2] * FINGERS_REACH
        return any(self._is_over_bin(point + side) for point in ways for side in (-sides, 0 * sides, sides))

    def _is_over_bin(self, point: np.ndarray) -> bool:
        away = abs(point - self.state.bin_position[:2])
        return bool((away < self.state.bin_interior[:2] / 2 + MARGIN).all())
