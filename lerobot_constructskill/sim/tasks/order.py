"""Orders: two objects and two bins, of which the instruction alone says which goes where."""

from collections.abc import Sequence

import numpy as np
import sapien
import torch
from mani_skill.utils.building import ActorBuilder
from mani_skill.utils.registration import register_env
from mani_skill.utils.structs import Actor

from lerobot_constructskill.contract import BRICK, ORDERS, TASKS
from lerobot_constructskill.sim.actions import Hold
from lerobot_constructskill.sim.scene import WALL, PickPlaceEnv
from lerobot_constructskill.sim.tasks.block import BLOCK, add_block
from lerobot_constructskill.sim.tasks.brick import add_brick

SIZES = {"brick": BRICK, "block": BLOCK}
"""Objects and their sizes in metres."""

COLOURS = {"grey": (0.22, 0.23, 0.24), "blue": (0.10, 0.22, 0.42)}
"""Bins and the colours of their walls, RGB from 0 to 1."""

OBJECT_PLACES = ((-0.28, 0.10), (0.0, 0.10))
BIN_PLACES = ((-0.28, -0.33), (0.02, -0.33))
"""Where the two objects and the two bins stand, x and y in metres; which stands where is drawn."""


class OrderEnv(PickPlaceEnv):
    """
    **Task Description:**
    A brick and a block wait, and a grey and a blue bin stand there. Put the object that the instruction names into the
    bin that it names. Of one seed, all four orders look the same.

    **Randomizations:**
    - Which object and which bin stand nearer to the robot.
    - Each object's centre is uniform within 0.04 m of its place in x and y; its yaw is fixed.

    **Success Conditions:**
    - Those of `PickPlaceEnv`, unless another placement came before: the other object, or the other bin.

    Args:
        asked: the object that is asked for, one of `SIZES`.
        into: the bin that it is to go into, one of `COLOURS`.
    """

    bin_interior = (0.25, 0.18, 0.10)
    spawn_range = 0.04
    yaw_range = 0.0
    hold = Hold(yaw=True)

    def __init__(self, *args, asked: str = "brick", into: str = "grey", **kwargs):
        self.asked, self.into = asked, into
        self.object_size = SIZES[asked]
        super().__init__(*args, **kwargs)

    @property
    def ways(self) -> list[tuple[Sequence[float], Sequence[float]]]:
        return [(start, end) for start in OBJECT_PLACES for end in BIN_PLACES]

    # Scene

    def _load_placements(self) -> None:
        self.all_bins = {name: self._build_bin(name) for name in COLOURS}
        self.all_objects = {name: self._build_object(name) for name in SIZES}
        self.bin, self.object = self.all_bins[self.into], self.all_objects[self.asked]
        self.objects = [self.object]

    def _build_bin(self, name: str) -> Actor:
        builder = self.scene.create_actor_builder()
        self._add_bin(builder, COLOURS[name])
        builder.initial_pose = sapien.Pose(p=[*BIN_PLACES[0], 1 + len(name)])  # apart until an episode begins
        return builder.build_kinematic(name=f"{name}_bin")

    def _build_object(self, name: str) -> Actor:
        builder = self.scene.create_actor_builder()
        self._add_object(builder, name)
        builder.initial_pose = sapien.Pose(p=[*OBJECT_PLACES[list(SIZES).index(name)], SIZES[name][2] / 2])
        return builder.build_dynamic(name=name)

    def _add_object(self, builder: ActorBuilder, name: str) -> None:
        if name == "brick":
            add_brick(self, builder, 0.0, SIZES[name])
        else:
            add_block(self, builder, SIZES[name])

    # Initial state

    def _initialize_objects(self, env_idx: torch.Tensor) -> None:
        drawn = np.reshape(self._batched_episode_rng[env_idx].uniform(-1, 1, size=6), (-1, 6))
        order = (drawn[:, :2] > 0).astype(int)  # of the first object and of the first bin
        for number, (name, one) in enumerate(self.all_objects.items()):
            offsets = self.spawn_range * drawn[:, 2 + 2 * number : 4 + 2 * number]
            places = np.array(OBJECT_PLACES)[order[:, 0] ^ number] + offsets
            self._stand(one, places, SIZES[name][2] / 2)
        for number, one in enumerate(self.all_bins.values()):
            self._stand(one, np.array(BIN_PLACES)[order[:, 1] ^ number], WALL + self.bin_interior[2] / 2)

    # Success

    def _conditions(self) -> dict[str, torch.Tensor]:
        info = super()._conditions()
        others = [
            self._is_in(one, bin_)
            for one in self.all_objects.values()
            for bin_ in self.all_bins.values()
            if (one, bin_) != (self.object, self.bin)
        ]
        is_other = torch.stack(others).any(dim=0) & info["is_gripper_open"]
        is_misplaced = self._has_lasted("is_misplaced", is_other & ~info["is_placed"])
        self._is_placed &= ~is_misplaced[:, None]
        is_as_asked = info["is_placed"] & ~is_misplaced
        return info | {"is_misplaced": is_misplaced, "is_placed": is_as_asked, "success": is_as_asked.clone()}


for _name, (_asked, _into) in ORDERS.items():
    register_env(TASKS[_name].env_id, max_episode_steps=TASKS[_name].horizon, asked=_asked, into=_into)(OrderEnv)
