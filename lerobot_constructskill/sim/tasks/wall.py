"""Walls: several elements laid after a plan, each on and beside what really lies there."""

import zlib
from collections.abc import Sequence

import numpy as np
import sapien
import torch
from mani_skill.utils.building import ActorBuilder
from mani_skill.utils.registration import register_env
from mani_skill.utils.structs import Actor

from lerobot_constructskill.contract import PLAN_TASK, SHIPPED
from lerobot_constructskill.plans.check import check_plan
from lerobot_constructskill.plans.plan import WAITS_WITHIN, Kind, Plan, Position, read_plan, supplies
from lerobot_constructskill.sim.actions import Hold
from lerobot_constructskill.sim.scene import FINGER_OPEN, LIFT_HEIGHT, PickPlaceEnv
from lerobot_constructskill.sim.strict import DEPTH_TOLERANCE, fits
from lerobot_constructskill.sim.tasks.brick import add_brick
from lerobot_constructskill.sim.visuals import mottled

OPENING = 0.015
"""Height in metres of what stands for a receptacle over the place of an element: it has no walls."""

SPRUCE = (205, 164, 110)

CHALK = (0.10, 0.25, 0.60)
LINE_LENGTH, BESIDE_LINE = 0.9, 0.01
"""Length of a chalk line and its distance from the faces of what is laid along it, in metres."""


class WallEnv(PickPlaceEnv):
    """
    **Task Description:**
    Lay the elements of a plan in its order. Each goes on and beside the placed ones as they really lie, so that what
    is laid first moves what comes after; where one is not placed, the plan's own place of it counts.

    **Randomizations:**
    - Every element waits within 0.03 m of its nominal place in x and y; its yaw is fixed.
    - Every element has a size of its own, within its standard's tolerance.

    **Success Conditions:**
    - Every element is within the plan's tolerance of its place in x and y, stands on what carries it, is upright,
      aligned and at rest for five consecutive steps while the gripper is open. One that is moved later counts again
      once this holds again.

    Args:
        plan: a name in `configs/plan` or a file.

    Raises:
        MissingError: there is no such plan.
        InputError: it is no plan, or cannot be built.
    """

    spawn_range = WAITS_WITHIN
    yaw_range = 0.0
    yaw_tolerance = np.radians(3.0)
    hold = Hold(yaw=True)

    def __init__(self, *args, plan: str = "course_of_three", **kwargs):
        self.plan: Plan = read_plan(plan)
        check_plan(self.plan)
        self.object_center = next(supplies(self.plan))
        super().__init__(*args, reconfiguration_freq=1, **kwargs)  # each episode has sizes of its own

    @property
    def ways(self) -> list[tuple[Sequence[float], Sequence[float]]]:
        return [(start, place[:2]) for start, place in zip(supplies(self.plan), self.plan.drawn, strict=True)]

    # Scene

    def _load_placements(self) -> None:
        self.sizes = self._draw_sizes()
        self.objects = [self._build(number, kind) for number, kind in enumerate(self.plan.kinds)]
        self.object = self.objects[0]
        self._sizes = torch.tensor(self.sizes, dtype=torch.float32, device=self.device)
        x, y, z = self._sizes.unbind(-1)
        self._edges: list[Position] = [*zip(x.unbind(-1), y.unbind(-1), z.unbind(-1), strict=True)]
        self._targets = torch.zeros(self.num_envs, len(self.objects), 3, device=self.device)

    def _load_hall(self) -> None:
        super()._load_hall()
        if self.scene.can_render():
            builder = self.scene.create_actor_builder()
            for x, y in self._lines():
                builder.add_box_visual(sapien.Pose([x, y, 0]), [LINE_LENGTH / 2, 0.0015, 0.0005], material=CHALK)
            builder.initial_pose = sapien.Pose()
            builder.build_static(name="chalk_line")

    def _lines(self) -> set[tuple[float, float]]:
        """Middles of the lines that are snapped on the slab along the courses, x and y in metres."""
        on_slab = [
            (place, kind)
            for place, kind, element in zip(self.plan.drawn, self.plan.kinds, self.plan.elements.values(), strict=True)
            if not element.on
        ]
        middle = sum(place[0] for place, _ in on_slab) / len(on_slab)
        return {(middle, round(place[1] - kind.size[1] / 2 - BESIDE_LINE, 4)) for place, kind in on_slab}

    def _draw_sizes(self) -> np.ndarray:
        """Sizes of all elements in metres, (num_envs, elements, 3), from the episodes' seeds."""
        nominal = np.array([kind.size for kind in self.plan.kinds])
        most = np.array([kind.deviations for kind in self.plan.kinds])
        mark = zlib.crc32(b"sizes")
        drawn = [np.random.default_rng([int(seed), mark]).uniform(-1, 1, most.shape) for seed in self._episode_seed]
        return nominal + most * np.array(drawn)

    def _build(self, number: int, kind: Kind) -> Actor:
        built = []
        for environment, sizes in enumerate(self.sizes):
            builder = self.scene.create_actor_builder()
            self._add_element(builder, kind, sizes[number])
            builder.initial_pose = sapien.Pose(p=[0, 0, 2 + number])
            builder.set_scene_idxs([environment])
            built.append(builder.build_dynamic(name=f"element_{number}_{environment}"))
        return built[0] if len(built) == 1 else Actor.merge(built, name=f"element_{number}")

    def _add_element(self, builder: ActorBuilder, kind: Kind, size: np.ndarray) -> None:
        if kind.factor:
            add_brick(self, builder, 0.0, size.tolist())
        else:
            self._add_box(builder, [0, 0, 0], size.tolist(), mottled(SPRUCE, contrast=0.06, seed=2), kind.density)

    # Initial state

    def _initialize_objects(self, env_idx: torch.Tensor) -> None:
        rng = self._batched_episode_rng[env_idx]
        offsets = np.reshape(rng.uniform(-1, 1, size=(len(self.objects), 2)), (-1, len(self.objects), 2))
        heights = self._sizes[env_idx, :, 2] / 2
        for number, place in enumerate(supplies(self.plan)):
            self._stand(self.objects[number], place + self.spawn_range * offsets[:, number], heights[:, number])

    # Success

    def _conditions(self) -> dict[str, torch.Tensor]:
        poses = self._object_poses()
        rest, was_placed = self._rest_positions(poses), self._is_placed
        speeds = torch.stack([one.linear_velocity.norm(dim=-1) for one in self.objects], dim=1)
        slack = torch.tensor([self.plan.tolerance, self.plan.tolerance, DEPTH_TOLERANCE], device=self.device)
        each = fits(poses, rest, slack, self.yaw_tolerance, speeds)
        is_gripper_open = (self.agent.robot.get_qpos()[:, -2:] >= FINGER_OPEN).all(dim=-1)
        lies = torch.stack([*each.values()]).all(dim=0)
        was_let_go = self._lasts("lies", lies & is_gripper_open[:, None])
        # What is laid on an element presses and shakes it.
        stays = torch.stack([value for name, value in each.items() if name != "is_at_rest"]).all(dim=0)
        self._safety.knock(was_placed & ~stays)
        self._is_placed = stays & (was_placed | was_let_go)
        self._targets = rest if torch.equal(was_placed, self._is_placed) else self._rest_positions(poses)
        self._lifted |= (poses[..., 2] >= LIFT_HEIGHT).any(dim=1)
        is_placed = self._is_placed.all(dim=1)
        return {
            "is_lifted": self._lifted.clone(),
            "is_in_bin": each["is_inside"].all(dim=1),
            "is_gripper_open": is_gripper_open,
            "is_placed": is_placed,
            **{name: value.all(dim=1) for name, value in each.items()},
            "success": is_placed.clone(),
        }

    def _rest_positions(self, poses: torch.Tensor) -> torch.Tensor:
        """Where the middle of each element comes to rest as the placed ones lie, (num_envs, elements, 3) metres."""

        def seen(number, place):
            lies, own = self._is_placed[:, number], poses[:, number].unbind(-1)
            return tuple(torch.where(lies, really, planned) for really, planned in zip(own, place, strict=False))

        places = [number for place in self.plan.resting(self._edges, seen) for number in place]
        columns = [torch.as_tensor(one, device=self.device).float().expand(self.num_envs) for one in places]
        return torch.stack(columns, dim=-1).reshape(self.num_envs, -1, 3)

    # Privileged state

    def moving_placements(self) -> dict[str, torch.Tensor]:
        middle = self._targets + (OPENING - self._sizes) / 2 * torch.tensor([0.0, 0.0, 1.0], device=self.device)
        return {"object_poses": self._object_poses(), "bin_positions": middle}

    def lasting_placements(self) -> dict[str, torch.Tensor]:
        interior = self._sizes + 2 * self.plan.tolerance
        interior[..., 2] = OPENING
        return super().lasting_placements() | {"object_sizes": self._sizes, "bin_interiors": interior}


for _task in (PLAN_TASK, *SHIPPED.values()):
    if _task.plan is not None:
        register_env(_task.env_id, max_episode_steps=_task.horizon, plan=_task.plan)(WallEnv)
