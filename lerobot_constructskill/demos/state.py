"""What an expert knows: the simulator's state, and how object, hand and receptacle stand to each other in it."""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from lerobot_constructskill.contract import MAX_PLACEMENTS, PLURALS

JAW = 0.08
"""How far the Panda's jaws open, in metres."""

PAD = 0.02
"""Width of a finger across the jaws, in metres."""

FINGERS_REACH, HAND_REACH, HAND_HEIGHT = 0.06, 0.105, 0.055
"""Distances in metres: along the jaws from the TCP to the outside of an open finger and to that of the hand, and from
the TCP up to the hand."""

TIPPED = np.radians(10)
"""Tilt in radians above which an object counts as tipped over."""

TILTED, ROLLED = 0.7, 0.2
"""Angles in radians above which a hand that a collision has bent no longer gets around an object: of the hand from
straight down, and of the jaws from level."""

SLIT, OPENED = 0.004, 0.036
"""Finger positions in metres: between them the fingers hold something, above the second they are open."""

GROUNDED = 0.015
"""Height in metres of an object's lowest corner below which the object still lies on something."""

MARGIN = 0.01
"""How far outside an object the TCP of the fingers that hold it may be, in metres; also more than a bin's wall."""


@dataclass(frozen=True)
class PrivilegedState:
    """The simulator's state as `contract.SIM_STATE` names it: float arrays, SI units, world frame.

    Data sets made before the joints, or the lists of placements, were recorded have none of them.
    """

    tcp_pose: np.ndarray
    fingers: np.ndarray
    object_pose: np.ndarray
    object_size: np.ndarray
    object_mass: np.ndarray
    bin_position: np.ndarray
    bin_interior: np.ndarray
    joint_positions: np.ndarray | None = None
    joint_velocities: np.ndarray | None = None
    placement: np.ndarray | None = None
    object_poses: np.ndarray | None = None
    object_sizes: np.ndarray | None = None
    object_masses: np.ndarray | None = None
    bin_positions: np.ndarray | None = None
    bin_interiors: np.ndarray | None = None
    is_object: np.ndarray | None = None
    is_placed: np.ndarray | None = None
    finger_forces: np.ndarray | None = None
    object_forces: np.ndarray | None = None

    @property
    def number(self) -> int:
        """The number of the placement that `object_*` and `bin_*` are of."""
        return 0 if self.placement is None else int(self.placement[0])

    @property
    def count(self) -> int:
        """How many placements the task has."""
        return 1 if self.is_object is None else int(self.is_object.sum())

    @property
    def is_done(self) -> bool:
        """Whether every placement is done."""
        return self.is_placed is not None and bool(self.is_placed[: self.count].all())

    def at(self, number: int) -> "PrivilegedState":
        """The same state with the placement `number` in place of the next one."""
        if number == self.number:
            return self
        own = {
            singular: np.reshape(getattr(self, plural), (MAX_PLACEMENTS, -1))[number]
            for singular, plural in PLURALS.items()
        }
        return replace(self, placement=np.array([number], np.float32), **own)

    def others(self) -> Iterator["PrivilegedState"]:
        """The state at every other placement."""
        return (self.at(number) for number in range(self.count) if number != self.number)

    @property
    def tcp(self) -> np.ndarray:
        """Position of the point between the finger tips, (3,)."""
        return self.tcp_pose[:3]

    @property
    def jaw_axis(self) -> np.ndarray:
        """Unit vector along which the fingers close, (3,): the y axis of the end effector."""
        w, x, y, z = self.tcp_pose[3:]
        return np.array([2 * (x * y - w * z), 1 - 2 * (x * x + z * z), 2 * (y * z + w * x)])

    @property
    def rim(self) -> float:
        """Height of the receptacle's rim."""
        return self.bin_position[2] + self.bin_interior[2] / 2

    @property
    def floor(self) -> float:
        """Height of the receptacle's floor."""
        return self.bin_position[2] - self.bin_interior[2] / 2

    @cached_property
    def rotation(self) -> np.ndarray:
        """Orientation of the object, (3, 3): its axes in the world, one a column."""
        w, x, y, z = self.object_pose[3:].astype(float)
        return np.array(
            [
                [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
                [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
                [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
            ]
        )

    @property
    def stands(self) -> bool:
        """Whether the object stands as it was put there, not tipped over and not upside down."""
        return bool(self.rotation[2, 2] > np.cos(TIPPED))

    @property
    def underside(self) -> float:
        """Height of the object's lowest corner, in metres."""
        return float(self.object_pose[2] - abs(self.rotation[2]) @ self.object_size / 2)

    @property
    def top(self) -> float:
        """Height of the object's highest corner, in metres."""
        return float(self.object_pose[2] + abs(self.rotation[2]) @ self.object_size / 2)

    @property
    def obstacle(self) -> float:
        """Height of the object's top or of the receptacle's rim, whichever is higher, in metres."""
        return max(self.top, float(self.rim))

    @property
    def width(self) -> float:
        """Width in metres of the part that goes between the jaws.

        An object wider than the jaws open has a handle, whose width is at most half of their opening.
        """
        own = float(self.object_size[1])
        return own if own < JAW else JAW / 2

    @property
    def skew(self) -> float:
        """Angle in radians between the jaws and the faces of the object that they are to take."""
        return float(np.arccos(np.clip(abs(self.rotation[:, 1] @ self.jaw_axis), 0, 1)))

    def play(self, skew: float) -> float:
        """How far the jaws may be off the object's middle on either side, in metres; below zero where they do not fit.

        Args:
            skew: angle between jaws and object in radians.
        """
        return float((JAW - self.width / np.cos(skew) - PAD * np.tan(skew)) / 2)

    @property
    def is_bent(self) -> bool:
        """Whether a collision has bent the hand so far that it cannot take anything."""
        x, y = self.tcp_pose[4:6].astype(float)
        down = 2 * (x * x + y * y) - 1
        return bool(down < np.cos(TILTED) or abs(self.jaw_axis[2]) > np.sin(ROLLED))

    @property
    def is_open(self) -> bool:
        return bool(min(self.fingers) > OPENED)

    @property
    def is_held(self) -> bool:
        """Whether something is between the fingers and the point between them is in the object."""
        fingers = self.fingers
        local = abs(self.rotation.T @ (self.tcp - self.object_pose[:3]))
        inside = (local < self.object_size / 2 + MARGIN).all()
        return bool(inside and max(fingers) <= OPENED and min(fingers) >= SLIT)

    def is_blocked(self, grasp: np.ndarray) -> bool:
        """Whether a wall of the bin is where a finger or the hand would be at the point `grasp`, (3,)."""
        low = [(FINGERS_REACH, grasp[2]), (HAND_REACH, grasp[2] + HAND_HEIGHT)]
        ends = [side * reach * self.jaw_axis[:2] for reach, height in low if height < self.rim for side in (-1, 1)]
        return any(self._is_over_bin(grasp[:2] + end) for end in ends)

    def crosses_bin(self, target: np.ndarray) -> bool:
        """Whether a hand that goes straight to `target` comes over the bin."""
        ways = np.linspace(self.tcp[:2], target[:2], 9)
        sides = self.jaw_axis[:2] * FINGERS_REACH
        return any(self._is_over_bin(point + side) for point in ways for side in (-sides, 0 * sides, sides))

    def _is_over_bin(self, point: np.ndarray) -> bool:
        away = abs(point - self.bin_position[:2])
        return bool((away < self.bin_interior[:2] / 2 + MARGIN).all())
