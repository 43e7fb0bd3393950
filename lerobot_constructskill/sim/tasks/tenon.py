"""Timber joint: the tenon of a post into the mortise of a sill."""

import numpy as np
from mani_skill.utils.building import ActorBuilder
from mani_skill.utils.registration import register_env

from lerobot_constructskill.contract import TASKS
from lerobot_constructskill.sim.strict import StrictPlaceEnv
from lerobot_constructskill.sim.visuals import mottled

POST = (0.06, 0.05, 0.07)
"""Of the post above its tenon, in metres."""

TENON = (0.05, 0.04, 0.04)
PLAY = 0.004
"""Metres that the mortise is longer and wider than the tenon."""

SILL = (0.16, 0.30, 0.05)
SPRUCE_DENSITY = 450.0
"""kg/m3."""

SPRUCE, LARCH = (205, 164, 110), (150, 96, 56)


@register_env(TASKS["tenon_to_mortise"].env_id, max_episode_steps=TASKS["tenon_to_mortise"].horizon)
class TenonToMortiseEnv(StrictPlaceEnv):
    """
    **Task Description:**
    Set a short timber post upright on a sill, its tenon in the mortise, with 4 mm of play.

    **Randomizations:**
    - The post's centre is uniform within 0.05 m of its nominal place in x and y; its yaw is fixed.

    **Success Conditions:**
    - Those of `StrictPlaceEnv`; the post's shoulders then stand on the sill.
    """

    object_size = (POST[0], POST[1], POST[2] + TENON[2])
    bin_floor = SILL[2] - TENON[2]
    bin_interior = (TENON[0] + PLAY, TENON[1] + PLAY, TENON[2])
    spawn_range = 0.05
    yaw_tolerance = np.radians(10.0)

    @property
    def play(self) -> tuple[float, float]:
        return (PLAY / 2, PLAY / 2)

    def _load_object(self, builder: ActorBuilder) -> None:
        for size, z in ((POST, TENON[2] / 2), (TENON, -POST[2] / 2)):
            self._add_timber(builder, [0, 0, z], size, SPRUCE)

    def _load_bin(self, builder: ActorBuilder) -> None:
        """A sill of four pieces around the mortise, and one under it."""
        x, y, depth = self.bin_interior
        floor, below = -depth / 2, SILL[2] - depth
        ends, sides = (SILL[1] - y) / 2, (SILL[0] - x) / 2
        self._add_timber(builder, [0, 0, floor - below / 2], [SILL[0], SILL[1], below], LARCH)
        for side in (-1, 1):
            self._add_timber(builder, [0, side * (y + ends) / 2, 0], [SILL[0], ends, depth], LARCH)
            self._add_timber(builder, [side * (x + sides) / 2, 0, 0], [sides, y, depth], LARCH)

    def _add_timber(self, builder: ActorBuilder, center, size, colour) -> None:
        self._add_box(builder, center, size, mottled(colour, contrast=0.06, seed=2), SPRUCE_DENSITY)
