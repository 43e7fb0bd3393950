"""The shared pick-and-place environment: robot, bin, cameras, initial states and the containment test.

A task derives from `PickPlaceEnv`, loads its asset and, where the layout differs, sets four geometry constants.
"""

from collections.abc import Callable, Sequence
from contextlib import nullcontext
from functools import cache
from itertools import product

import numpy as np
import sapien
import torch
from mani_skill.envs.sapien_env import BaseEnv
from mani_skill.envs.utils.randomization.batched_rng import BatchedRNG
from mani_skill.sensors.camera import CameraConfig
from mani_skill.utils import common
from mani_skill.utils.building import ActorBuilder
from mani_skill.utils.geometry.rotation_conversions import quaternion_apply, quaternion_to_axis_angle
from mani_skill.utils.structs import Actor, Pose
from mani_skill.utils.structs.types import SimConfig
from torch.nn.functional import pad
from transforms3d.euler import euler2quat

from lerobot_constructskill.contract import (
    BRICK,
    CAMERAS,
    FPS,
    IMAGE_SIZE,
    MAX_PLACEMENTS,
    OBS_TYPES,
    PLURALS,
    REWARD_LIFTED,
    REWARD_PLACED,
    ROBOT_BASE,
    Camera,
)
from lerobot_constructskill.errors import InputError, MachineError
from lerobot_constructskill.perturbations import Perturbation
from lerobot_constructskill.sim.actions import HOLDING, Clipping, Delay, Hold
from lerobot_constructskill.sim.backends import best_render_backend, enable_gpu_physics, machine_lacks, steps_on_gpu
from lerobot_constructskill.sim.contacts import Safety, touch
from lerobot_constructskill.sim.perturb import Draws
from lerobot_constructskill.sim.robot import LightPanda, QuickPanda, seen_from
from lerobot_constructskill.sim.visuals import colour_shader, looking_from, mottled, shining_sun, textured

WALL = 0.005
"""Thickness of the bin's walls and floor, in metres (paper, section II)."""

LIFT_HEIGHT = 0.15
"""Height in metres that the object's centre must reach to count as lifted (paper, section III)."""

RIM_ALLOWANCE = 0.025
"""Added in metres to half the bin's height, so that an object resting against the rim counts (paper, section III)."""

FINGER_OPEN = 0.038
"""Position in metres at which a finger counts as open; its limit is 0.04, a held brick keeps it at 0.0325."""

PLACED_STEPS = 5
"""Consecutive steps inside the bin, gripper open, that make a placement (paper, section III)."""

HALL_HALF_WIDTH, HALL_HEIGHT = 3.0, 3.0

FILM_SIZE = 960, 720
"""Width and height of a film's pictures, in pixels."""

BAYS, BAY, JOINT = 3, 2.0, 0.008
"""Of the slab: bays a side, their width and that of the joints between them, in metres."""


@cache
def keep_software_renderer() -> sapien.render.RenderSystem:
    """Hold SAPIEN's renderer until the process ends.

    SAPIEN lets go of it with the last scene, and Mesa then compiles every shader again: 7 s of CPU time instead of 0.3
    for each further environment.
    """
    return sapien.render.RenderSystem("cpu")


def outside_autocast[**P, R](method: Callable[P, R]) -> Callable[P, R]:
    """Have a method compute in full precision, whatever autocast surrounds its call.

    With `use_amp`, `lerobot-eval` steps its environments under the same autocast as the policy.
    """
    return torch.autocast("cpu", enabled=False)(torch.autocast("cuda", enabled=False)(method))


class PickPlaceEnv(BaseEnv):
    """
    **Task Description:**
    Pick an object from the ground and place it in an open-topped bin. A task overrides `_load_object` and the
    four geometry constants below.

    The default distribution turns the object all the way round; an expert for it needs the rotation channels.

    **Randomizations:**
    - The object's centre is uniform within `spawn_range` of `object_center` in x and y.
    - Its yaw is uniform within `yaw_range` of zero; the default is a full turn.
    Both come from the episode's own generator, so an episode does not depend on the batch it runs in.

    **Success Conditions:**
    - The object's centre is inside `placement_bounds` of the bin's centre and both fingers are open, for five
      consecutive steps.

    Args:
        cameras: names of the cameras in `contract.CAMERAS` to observe with; the base camera by default.
        light_robot: draw the Panda with decimated meshes. By default only where frames are rendered on a CPU.
        robot_uids: ManiSkill's; the Panda by default, drawn as `light_robot` says.
        perturbation: what differs from the task as it is; nothing by default.
        film: `render` shows shadows and has 720 lines, which takes a CPU several times as long.
        render_backend: ManiSkill's, or "auto": a GPU that can render, else Mesa's lavapipe.

    Raises:
        OSError: there is no Vulkan device to render with, no window to show, or no GPU for several environments.
        ValueError: another brick size is asked of a task without a brick, a dense reward, or an observation or control
            mode that there is not.

    Non-obvious behaviours: the rotation channels are part of the action as in any `pd_ee_delta_pose`
    environment; `is_lifted` and `is_placed` hold for the rest of an episode, the other booleans are momentary.
    """

    SUPPORTED_ROBOTS = ["panda", QuickPanda.uid, LightPanda.uid]
    SUPPORTED_REWARD_MODES = ("sparse", "none")

    # The four geometry constants, in metres.
    object_size = BRICK
    object_center = (0.0, 0.0)
    bin_center = (0.0, -0.35)
    bin_interior = (0.25, 0.20, 0.15)

    bin_floor = WALL
    """Height of the floor that a placed object stands on, in metres."""

    # The initial-state distribution, in metres and radians.
    spawn_range = 0.10
    yaw_range = np.pi

    is_brick = False
    """Whether the object is a brick, whose size may vary within EN 771-1's tolerance."""

    hold: Hold | None = None
    """Which rotations of the hand the scene holds, whatever the action says; the paper's scene holds none."""

    def __init__(
        self,
        *args,
        cameras: tuple[str, ...] = OBS_TYPES["pixels"],
        light_robot: bool | None = None,
        robot_uids: str | None = None,
        control_mode: str = "pd_ee_delta_pose",
        render_backend: str = "auto",
        perturbation: Perturbation | None = None,
        film: bool = False,
        **kwargs,
    ):
        self.film = film
        self.draws = Draws(perturbation or Perturbation())
        self.draws.perturbation.check_size(self.is_brick)
        if self.draws.latency and control_mode != HOLDING:
            raise InputError(f"The axis 'latency' delays actions of {HOLDING}, not of {control_mode}.")
        self.object_size = self.draws.brick(self.object_size)
        if render_backend == "auto":
            render_backend = best_render_backend()
        elif render_backend == "gpu" and best_render_backend() != "gpu":
            raise MachineError(
                "render_backend must be auto or cpu on this machine, where no GPU can render, not 'gpu'; "
                "`constructskill-doctor` says what is missing."
            )
        if kwargs.get("reward_mode") not in (None, *self.SUPPORTED_REWARD_MODES):
            raise InputError(
                "reward_mode must be sparse (the stage reached: 0, 0.5 once lifted, 1 once placed) or none, not "
                f"'{kwargs['reward_mode']}': there is no dense reward."
            )
        self.cameras = tuple(cameras)
        in_software = render_backend in ("cpu", "sapien_cpu")
        self.light_robot = in_software if light_robot is None else light_robot
        robot = LightPanda if self.light_robot else QuickPanda
        if steps_on_gpu(kwargs.get("sim_backend", "auto"), kwargs.get("num_envs", 1)):
            enable_gpu_physics(in_software)
        try:
            if in_software:
                keep_software_renderer()
            super().__init__(
                *args,
                robot_uids=robot_uids or robot.uid,
                control_mode=control_mode,
                render_backend=render_backend,
                **kwargs,
            )
        except AssertionError as error:  # ManiSkill's sentence about one of its arguments
            if not str(error):
                raise
            raise InputError(str(error)) from error
        except RuntimeError as error:
            if (lack := machine_lacks(error)) is None:
                raise
            raise lack from None

    @property
    def _default_sim_config(self) -> SimConfig:
        return SimConfig(control_freq=FPS)

    # What a task declares

    def _load_object(self, builder: ActorBuilder) -> None:
        """Give `builder` the object's collision shapes and visuals, centred at its origin, unrotated."""
        raise NotImplementedError

    # Scene

    @property
    def _default_sensor_configs(self) -> list[CameraConfig]:
        return [self._camera_config(CAMERAS[name]) for name in self.cameras]

    def _camera_config(self, camera: Camera) -> CameraConfig:
        if camera.mount is None:
            view = {"pose": looking_from(self.draws.eye(camera.eye), camera.target)}
        else:  # looks along the hand's approach axis
            pose = sapien.Pose(p=camera.eye, q=euler2quat(0, -np.pi / 2, 0))
            view = {"pose": pose, "mount": self.agent.robot.links_map[camera.mount]}
        asked = {name for name, is_asked in vars(self.obs_mode_struct.visual).items() if is_asked}
        is_colour_enough = asked == {"rgb"} and not self.backend.render_device.is_cuda()
        shader = colour_shader() if is_colour_enough else None
        size = {"width": IMAGE_SIZE, "height": IMAGE_SIZE}
        return CameraConfig(camera.name, fov=camera.fov, shader_config=shader, **size, **view)

    @property
    def _default_human_render_camera_configs(self) -> CameraConfig:
        pose = looking_from((0.9, -1.0, 0.8), (-0.1, -0.15, 0.15))
        width, height = FILM_SIZE if self.film else (512, 512)
        return CameraConfig("render_camera", pose=pose, width=width, height=height, fov=0.9)

    def render(self) -> torch.Tensor | np.ndarray:
        with shining_sun(self.scene) if self.film else nullcontext():
            return super().render()

    def _load_agent(self, options: dict) -> None:
        super()._load_agent(options, sapien.Pose(p=ROBOT_BASE))

    def _load_scene(self, options: dict) -> None:
        self._load_hall()
        self._load_offcuts()
        self._load_placements()
        self._lasting: tuple[dict[str, torch.Tensor], dict[str, torch.Tensor]] | None = None
        self._is_placed = torch.zeros(self.num_envs, len(self.objects), dtype=torch.bool, device=self.device)
        self._lifted = torch.zeros(self.num_envs, dtype=torch.bool, device=self.device)
        self._unmet: dict[str, torch.Tensor] = {}  # by condition: the last step in which it was not met
        self._lasted: dict[str, torch.Tensor] = {}
        self._clipping = Clipping(self.num_envs, self.device)
        self._delay = Delay(self.num_envs, self.device, self.draws.latency)
        self._safety = Safety(self.num_envs, len(self.objects), self.device)

    def _load_placements(self) -> None:
        """Build `objects`, in the order in which they are placed, and where they go."""
        builder = self.scene.create_actor_builder()
        self._load_bin(builder)
        builder.initial_pose = sapien.Pose(p=self.bin_position)
        self.bin = builder.build_kinematic(name="bin")
        builder = self.scene.create_actor_builder()
        self._load_object(builder)
        builder.initial_pose = sapien.Pose(p=[*self.object_center, self.object_size[2] / 2])
        self.object = builder.build_dynamic(name="object")
        self.objects = [self.object]

    def _load_hall(self) -> None:
        """Ground plane, and the plastered walls of the building around it; the walls do not collide."""
        builder = self.scene.create_actor_builder()
        builder.add_plane_collision(sapien.Pose(q=euler2quat(0, -np.pi / 2, 0)))
        if self.scene.can_render():
            colour, pattern = self.draws.surface("ground", (150, 146, 138), 1)
            concrete = textured(mottled(colour, contrast=0.06, seed=pattern))
            plaster = textured(mottled((222, 217, 206), contrast=0.02, seed=2))
            w, h, t = HALL_HALF_WIDTH, HALL_HEIGHT / 2, 0.01
            half, middles = (BAY - JOINT) / 2, BAY * (np.arange(BAYS) - (BAYS - 1) / 2)
            for x, y in product(middles, middles):  # the slab; joints are open, and black
                builder.add_box_visual(sapien.Pose([x, y, -t]), [half, half, t], material=concrete)
            for side in (-w, w):
                builder.add_box_visual(sapien.Pose([side, 0, h]), [t, w, h], material=plaster)
                builder.add_box_visual(sapien.Pose([0, side, h]), [w, t, h], material=plaster)
        builder.initial_pose = sapien.Pose()
        builder.build_static(name="hall")

    def _load_offcuts(self) -> None:
        """Distractors: fixed wooden boxes away from the object, the bin and the way between them."""
        taken = np.vstack([ROBOT_BASE[:2], *(np.linspace(start, end, 5) for start, end in self.ways)])
        for i, (size, place) in enumerate(self.draws.offcuts(taken, self.spawn_range + 0.18)):
            builder = self.scene.create_actor_builder()
            self._add_box(builder, [0, 0, 0], size, (0.55, 0.38, 0.20))
            builder.initial_pose = sapien.Pose(p=place)
            builder.build_static(name=f"offcut_{i}")

    def _load_lighting(self, options: dict) -> None:
        self.scene.set_ambient_light([0.5, 0.5, 0.5])
        self.scene.add_directional_light(*self.draws.light([1, 1, -1], [0.9, 0.9, 0.9]), shadow=self.enable_shadow)
        self.scene.add_directional_light(*self.draws.light([0, 0, -1], [0.6, 0.6, 0.6]))

    def _load_bin(self, builder: ActorBuilder) -> None:
        """Give `builder` the receptacle's collision shapes and visuals; its origin is the middle of `bin_interior`.

        By default a floor and four walls around `bin_interior`.
        """
        self._add_bin(builder, (0.10, 0.22, 0.42))

    def _add_bin(self, builder: ActorBuilder, colour: tuple[float, float, float]) -> None:
        """Add a floor and four walls around `bin_interior` to an actor, in a colour as RGB from 0 to 1."""
        x, y, z = self.bin_interior
        panels = [([0, 0, -(z + WALL) / 2], [x + 2 * WALL, y + 2 * WALL, WALL])]
        panels += [([side * (x + WALL) / 2, 0, 0], [WALL, y + 2 * WALL, z]) for side in (-1, 1)]
        panels += [([0, side * (y + WALL) / 2, 0], [x, WALL, z]) for side in (-1, 1)]
        for center, size in panels:
            self._add_box(builder, center, size, colour)

    def _add_box(
        self,
        builder: ActorBuilder,
        center: Sequence[float] | sapien.Pose,
        size: Sequence[float],
        look: tuple[float, float, float] | np.ndarray,
        density: float = 1000.0,
    ) -> None:
        """Add a box to an actor, which collides and is seen.

        Args:
            center: position in the actor's frame, (3,) metres, or a pose in it.
            size: edges in metres, (3,).
            look: colour as RGB from 0 to 1, or a texture, (H, W, 3) uint8.
            density: kg/m3.
        """
        pose = center if isinstance(center, sapien.Pose) else sapien.Pose(center)
        half_size = np.array(size) / 2
        builder.add_box_collision(pose, half_size, density=density)
        if self.scene.can_render():
            material = textured(look) if isinstance(look, np.ndarray) else look
            builder.add_box_visual(pose, half_size, material=material)

    # Gymnasium

    reset = outside_autocast(BaseEnv.reset)
    step = outside_autocast(BaseEnv.step)

    # Initial state

    def _set_episode_rng(self, seed, env_idx: torch.Tensor) -> None:
        # ManiSkill leaves the last seed standing where a reset has none, and goes on with the generators.
        self._has_own_seed = seed is not None
        super()._set_episode_rng(seed, env_idx)

    def _initialize_episode(self, env_idx: torch.Tensor, options: dict) -> None:
        with torch.device(self.device):
            self.agent.reset(self._initial_qpos(env_idx))
            self.agent.robot.set_pose(sapien.Pose(p=ROBOT_BASE))
            self._initialize_objects(env_idx)
            kept = (self._is_placed, self._lifted, self._clipping.steps)
            for memory in (*kept, *self._unmet.values(), *self._lasted.values()):
                memory[env_idx] = 0
            self._safety.forget(env_idx)
            self._delay.forget(env_idx)

    def _initialize_objects(self, env_idx: torch.Tensor) -> None:
        offsets = torch.from_numpy(self._spawn_offsets(self._batched_episode_rng[env_idx])).float()
        offsets = offsets.to(self.device)
        position = torch.tensor([*self.object_center, self.object_size[2] / 2]).repeat(len(env_idx), 1)
        position[:, :2] += offsets[:, :2]
        half_yaw = offsets[:, 2] / 2
        zero = torch.zeros_like(half_yaw)
        quaternion = torch.stack([torch.cos(half_yaw), zero, zero, torch.sin(half_yaw)], dim=-1)
        self.object.set_pose(Pose.create_from_pq(position, quaternion))

    def _stand(self, actor: Actor, places: np.ndarray, heights: float | torch.Tensor) -> None:
        """Set an actor upright on places (len(env_idx), 2), its origin at a height, or one for each, in metres."""
        position = torch.zeros(len(places), 3)
        position[:, :2] = torch.from_numpy(places)
        position[:, 2] = heights
        upright = torch.tensor([[1.0, 0, 0, 0]]).repeat(len(places), 1)
        actor.set_pose(Pose.create_from_pq(position, upright))

    def _initial_qpos(self, env_idx: torch.Tensor) -> np.ndarray:
        """Joint positions of the rest keyframe, with noise where the pose is perturbed, (9,) or (len(env_idx), 9)."""
        rest, amount = self.agent.keyframes["rest"].qpos, self.draws.perturbation.amount("pose")
        if not amount:
            return rest
        joints = len(rest) - 2
        if self._has_own_seed:
            seeds = [[int(self._episode_seed[i]), self.draws.perturbation.seed] for i in env_idx.cpu()]
            noise = np.array([np.random.default_rng(seed).standard_normal(joints) for seed in seeds])
        else:
            noise = np.reshape(self._batched_episode_rng[env_idx].standard_normal(size=joints), (-1, joints))
        return rest + amount * np.pad(noise, ((0, 0), (0, 2)))

    def _spawn_offsets(self, rng: BatchedRNG) -> np.ndarray:
        """One row (dx, dy, dyaw) per episode generator in `rng`, in metres and radians."""
        scale = np.array([self.spawn_range, self.spawn_range, self.yaw_range])
        return np.reshape(rng.uniform(-1, 1, size=3), (-1, 3)) * scale

    # Action

    def _step_action(self, action):
        if self.control_mode == HOLDING and isinstance(action, np.ndarray | torch.Tensor):
            action = self._clipping.apply(common.to_tensor(action, device=self.device), self.elapsed_steps)
            action = self._delay.apply(action)
            if self.hold is not None:
                action = self.hold.apply(action, self.agent.tcp.pose.q)
        return super()._step_action(action)

    def _after_control_step(self) -> None:
        upward = torch.stack([one.linear_velocity[:, 2] for one in self.objects], dim=1)
        self._safety.judge(touch(self.scene, self.agent.robot.links_map, self.objects), upward)

    # Success

    @property
    def ways(self) -> list[tuple[Sequence[float], Sequence[float]]]:
        """From where to where each object goes, x and y in metres."""
        return [(self.object_center, self.bin_center)]

    @property
    def bin_position(self) -> tuple[float, float, float]:
        """Centre of the bin's interior, in metres."""
        return (*self.bin_center, self.bin_floor + self.bin_interior[2] / 2)

    @property
    def rest_position(self) -> tuple[float, float, float]:
        """Where the object's centre is once it stands in the middle of the bin, in metres."""
        return (*self.bin_center, self.bin_floor + self.object_size[2] / 2)

    @property
    def placement_bounds(self) -> tuple[float, float, float]:
        """Largest distance in x, y and z between the object's and the bin's centre, in metres."""
        x, y, z = (extent / 2 for extent in self.bin_interior)
        return (x, y, z + RIM_ALLOWANCE)

    def evaluate(self) -> dict[str, torch.Tensor]:
        """Named booleans and counts, each (num_envs,); calling it twice in one step changes nothing."""
        return self._conditions() | {
            "placements": self._is_placed.sum(dim=1),
            "chain": self._chain(),
            "clipped_steps": self._clipping.steps.clone(),
            **self._safety.info(),
        }

    def _chain(self) -> torch.Tensor:
        """How many placements are done before the first that is not, (num_envs,)."""
        return self._is_placed.long().cumprod(dim=1).sum(dim=1)

    def _conditions(self) -> dict[str, torch.Tensor]:
        """Named booleans, `success` among them, each (num_envs,); `_is_placed` keeps which placements are done."""
        is_in_bin = self._is_in(self.object, self.bin)
        is_gripper_open = (self.agent.robot.get_qpos()[:, -2:] >= FINGER_OPEN).all(dim=-1)
        self._lifted |= self.object.pose.p[:, 2] >= LIFT_HEIGHT
        is_placed = self._has_lasted("is_placed", is_in_bin & is_gripper_open)
        self._is_placed[:] = is_placed[:, None]
        return {
            "is_lifted": self._lifted.clone(),
            "is_in_bin": is_in_bin,
            "is_gripper_open": is_gripper_open,
            "is_placed": is_placed,
            "success": is_placed.clone(),
        }

    def _is_in(self, one: Actor, receptacle: Actor) -> torch.Tensor:
        """Whether the centre of an object is inside `placement_bounds` of a receptacle's, (num_envs,)."""
        offset = (one.pose.p - receptacle.pose.p).abs()
        return (offset <= torch.tensor(self.placement_bounds, device=self.device)).all(dim=-1)

    def _lasts(self, name: str, is_met: torch.Tensor) -> torch.Tensor:
        """Whether a condition was met in `PLACED_STEPS` consecutive steps until now, booleans of its shape.

        Args:
            name: of the condition, by which its memory is kept.
            is_met: whether it is met now, (num_envs,) or (num_envs, placements).
        """
        elapsed = self.elapsed_steps.reshape(-1, *[1] * (is_met.ndim - 1)).expand(is_met.shape)
        last_unmet = torch.where(is_met, self._unmet.get(name, torch.zeros_like(elapsed)), elapsed)
        self._unmet[name] = last_unmet
        return elapsed - last_unmet >= PLACED_STEPS

    def _has_lasted(self, name: str, is_met: torch.Tensor) -> torch.Tensor:
        """Whether a condition has ever lasted in the episode. Arguments and result as of `_lasts`."""
        self._lasted[name] = self._lasted.get(name, torch.zeros_like(is_met)) | self._lasts(name, is_met)
        return self._lasted[name].clone()

    def compute_sparse_reward(self, obs, action: torch.Tensor, info: dict) -> torch.Tensor:
        """The stage reached, of shape (num_envs,)."""
        reached = torch.where(info["success"], REWARD_PLACED, 0.0)
        return torch.where(info["is_lifted"], reached.clamp(min=REWARD_LIFTED), reached)

    # Observations

    def _get_obs_extra(self, info: dict) -> dict[str, torch.Tensor]:
        extra = {"tcp_pose": self.agent.tcp.pose.raw_pose}
        if "state" in self.obs_mode:
            moving = self.moving_placements()
            extra |= {"object_pose": moving["object_poses"].flatten(1)}
            extra |= {"bin_position": moving["bin_positions"].flatten(1)}
        return extra

    @outside_autocast
    def agent_state(self) -> torch.Tensor:
        """Proprioception as `contract.STATE_NAMES` names it, (num_envs, 8), in the robot's base frame.

        The gripper points down, half a turn about x, where the usual axis-angle jumps between +pi and -pi; the
        sign of the quaternion is chosen so that the x component stays positive and continuous there. Computed in
        float64 and rounded once, because torch's float32 sines differ by a bit between instruction sets.
        """
        tcp = seen_from(self.agent.robot.root, self.agent.tcp)
        rotation = quaternion_to_axis_angle(torch.where(tcp.q[:, 1:2] < 0, -tcp.q, tcp.q).double()).float()
        return torch.cat([tcp.p, rotation, self.agent.robot.get_qpos()[:, -2:]], dim=-1)

    @outside_autocast
    def force(self) -> torch.Tensor:
        """What pulls at the wrist as `contract.FORCE_NAMES` names it, (num_envs, 3)."""
        robot = self.agent.robot
        hand = robot.links_map["panda_hand"]
        pull = robot.get_link_incoming_joint_forces()[:, hand.index[0], :3]  # in the hand's frame
        return quaternion_apply(seen_from(robot.root, hand).q, pull)

    @outside_autocast
    def privileged_state(self) -> dict[str, torch.Tensor]:
        """The state that experts read, as `contract.SIM_STATE` names it; each of shape (num_envs, n)."""
        joints, moving = self.agent.robot.get_qpos(), self.moving_placements()
        count, one = len(self.objects), torch.arange(self.num_envs, device=self.device)
        following = self._chain().clamp(max=count - 1)
        if self._lasting is None:
            lasting = self.lasting_placements()
            self._lasting = lasting, {name: _listed(value) for name, value in lasting.items()}
        lasting, listed = self._lasting
        return {
            "tcp_pose": self.agent.tcp.pose.raw_pose,
            "fingers": joints[:, -2:],
            **{singular: (moving | lasting)[plural][one, following] for singular, plural in PLURALS.items()},
            "joint_positions": joints,
            "joint_velocities": self.agent.robot.get_qvel(),
            "placement": following[:, None].float(),
            "is_placed": _listed(self._is_placed[..., None].float()),
            "finger_forces": self._safety.touch.fingers.flatten(1),
            "object_forces": _listed(self._safety.touch.objects[..., None]),
            **listed,
            **{name: _listed(value) for name, value in moving.items()},
        }

    def moving_placements(self) -> dict[str, torch.Tensor]:
        """What `contract.SIM_STATE` lists of the placements and what changes, each (num_envs, placements, n)."""
        return {"object_poses": self._object_poses(), "bin_positions": self.bin.pose.p[:, None]}

    def _object_poses(self) -> torch.Tensor:
        """Poses of all objects, (num_envs, placements, 7)."""
        return torch.stack([one.pose.raw_pose for one in self.objects], dim=1)

    def lasting_placements(self) -> dict[str, torch.Tensor]:
        """What it lists of them and what stays as long as the scene does, each (num_envs, placements, n)."""
        return {
            "object_sizes": self._of_each(self.object_size),
            "object_masses": torch.stack([one.mass for one in self.objects], dim=1)[..., None].to(self.device),
            "bin_interiors": self._of_each(self.bin_interior),
            "is_object": self._of_each([1.0]),
        }

    def _of_each(self, values: Sequence[float]) -> torch.Tensor:
        """The same numbers of every placement in every environment, (num_envs, placements, n)."""
        return torch.tensor(values, device=self.device).expand(self.num_envs, len(self.objects), -1)


def _listed(value: torch.Tensor) -> torch.Tensor:
    """Values of some placements, (num_envs, placements, n), as the privileged state lists them: of the most, flat."""
    return pad(value, (0, 0, 0, MAX_PLACEMENTS - value.shape[1])).flatten(1)
