"""Ceiling tile into a grid opening: a panel laid onto the flanges of its T-bars."""

import numpy as np
import sapien
from mani_skill.utils.building import ActorBuilder
from mani_skill.utils.registration import register_env

from lerobot_constructskill.contract import TASKS
from lerobot_constructskill.sim.strict import StrictPlaceEnv

SIDE, THICKNESS = 0.149, 0.010
"""Of the tile in metres: a 595 mm tile at a scale of 1:4, somewhat thicker."""

CLEARANCE = 0.005
"""Metres that the opening is wider than the tile, as a 600 mm grid than a 595 mm tile; the play is not scaled."""

HANDLE = (0.05, 0.04, 0.05)
"""Of the vacuum lifter that stands on the tile and that the jaws hold, in metres."""

MINERAL_FIBRE_DENSITY = 300.0
"""kg/m3."""

GRID_HEIGHT, FLANGE, BAR, BAR_HEIGHT = 0.10, 0.012, 0.006, 0.012
"""Height of the flanges above the ground, their width, and a bar's thickness and height above them, in metres."""

WHITE, STEEL, RUBBER = (0.85, 0.85, 0.83), (0.45, 0.47, 0.50), (0.80, 0.35, 0.05)


@register_env(TASKS["tile_to_grid"].env_id, max_episode_steps=TASKS["tile_to_grid"].horizon)
class TileToGridEnv(StrictPlaceEnv):
    """
    **Task Description:**
    Take a ceiling tile by the lifter that stands on it and lay it into an opening of the grid, with 5 mm of clearance.

    **Randomizations:**
    - The tile's centre is uniform within 0.05 m of its nominal place in x and y; its yaw is fixed.

    **Success Conditions:**
    - Those of `StrictPlaceEnv`.
    """

    object_size = (SIDE, SIDE, THICKNESS + HANDLE[2])
    bin_floor = GRID_HEIGHT
    bin_interior = (SIDE + CLEARANCE, SIDE + CLEARANCE, BAR_HEIGHT)
    spawn_range = 0.05

    def _load_object(self, builder: ActorBuilder) -> None:
        parts = [([SIDE, SIDE, THICKNESS], -HANDLE[2] / 2, WHITE), (HANDLE, THICKNESS / 2, RUBBER)]
        for size, z, colour in parts:
            self._add_box(builder, [0, 0, z], size, colour, MINERAL_FIBRE_DENSITY)

    def _load_bin(self, builder: ActorBuilder) -> None:
        """Four T-bars around the opening, on four posts; the origin is the middle of the opening."""
        inner, floor = self.bin_interior[0] / 2, -BAR_HEIGHT / 2
        for turn in range(4):
            frame = sapien.Pose(q=[np.cos(turn * np.pi / 4), 0, 0, np.sin(turn * np.pi / 4)])
            boxes = [
                ([inner + BAR / 2, 0, 0], [BAR, 2 * inner + 2 * BAR, BAR_HEIGHT]),
                ([inner + (BAR - FLANGE) / 2, 0, floor - BAR / 2], [BAR + FLANGE, 2 * (inner + BAR), BAR]),
                ([inner + BAR / 2, inner + BAR / 2, floor - GRID_HEIGHT / 2], [BAR, BAR, GRID_HEIGHT]),
            ]
            for center, size in boxes:
                self._add_box(builder, frame * sapien.Pose(center), size, STEEL)
