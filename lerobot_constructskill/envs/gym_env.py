"""One environment as LeRobot wants it: Gymnasium's API, numpy in and out, metres in the action."""

import functools
import gc
import json
import multiprocessing
import zlib
from typing import Annotated, Any

import gymnasium as gym
import numpy as np
from gymnasium import spaces

from lerobot_constructskill.bounds import Among, Seed, Steps, check_fields
from lerobot_constructskill.contract import (
    ACTIONS,
    BRICK,
    FPS,
    IMAGE_SIZE,
    LADDER,
    OBS_TYPES,
    STATE_NAMES,
    TASK_ACTION,
    Task,
    get_task,
    state_names,
)
from lerobot_constructskill.envs.actions import action_bounds, normalised
from lerobot_constructskill.envs.recording import COUNTS, keep, recorder
from lerobot_constructskill.errors import InputError, MachineError, remedy_of
from lerobot_constructskill.interface import describe_task
from lerobot_constructskill.perturbations import Perturbation
from lerobot_constructskill.plans.check import check_plan
from lerobot_constructskill.plans.plan import read_plan
from lerobot_constructskill.threads import one_thread

ObsType = Annotated[str, Among(tuple(OBS_TYPES))]
ActionForm = Annotated[str, Among(ACTIONS)]
SEEING = ("auto", "gpu", "cpu")


def perturbed_task(name: str, perturb: str, perturb_seed: int, action: str = TASK_ACTION) -> tuple[Task, Perturbation]:
    """The task and its perturbation.

    Raises:
        InputError: no such task, axis or level, a plan that cannot be built, or a brick of another size where none is
            or where it does not fit.
    """
    task, perturbation = get_task(name, action), Perturbation(perturb, perturb_seed)
    if task.plan is not None:
        check_plan(read_plan(task.plan))
    perturbation.check(task)
    if perturbation.amount("size") and name in LADDER:
        from lerobot_constructskill.sim.perturb import Draws, check_fits

        check_fits(Draws(perturbation).brick(BRICK), LADDER[name])
    return task, perturbation


class ConstructSkillEnv(gym.Env):
    """A task of the contract table for LeRobot's scripts, or for any Gymnasium user.

    Observations are `{"pixels": {camera: (224, 224, 3) uint8}}`, with `obs_type="pixels_agent_pos"` also
    `"agent_pos": (8,) float32` as `contract.STATE_NAMES` names it, and with `"pixels_agent_pos_force"` three numbers
    more, `contract.FORCE_NAMES`. An action is (dx, dy, dz) in metres, in tasks that turn dyaw in radians, and the
    gripper, +1 open, -1 closed, float32; more than 0.1 is clipped. With `action="full"` it is `contract.FULL_ACTION`
    in every task; a scene that holds the hand level overwrites the rotations that its task does not name. The reward
    is the stage reached: 0, 0.5 once lifted, 1 once all is placed. `info` holds `is_success`, the named booleans of
    the scene, `clipped_steps`, how many of the episode's actions were clipped, `placements`, how many of the task's
    are done, `chain`, how many before the first that is not, and what was unsafe: `cost` of the step, and of the
    episode `peak_force` (N), `drops`, `knocks` and `collisions`; after a reset also `contract`, as JSON.

    Non-obvious behaviours: the simulator starts with the first `reset`, in the process that calls it, so
    constructing an environment costs nothing. `render` shows a close-up, not what the policy sees.

    Args:
        task: a name in `contract.TASKS`, or `plan:NAME_OR_FILE`.
        obs_type: `pixels` (the base camera), `pixels_agent_pos` (adds the wrist camera and the state) or
            `pixels_agent_pos_force` (adds the force at the wrist to the state).
        episode_length: steps after which an episode is truncated; the task's horizon by default.
        light_robot: draw the robot with decimated meshes; by default only where frames are rendered on a CPU.
        render_backend: "auto" (a GPU that can render, else the CPU), "gpu", "cpu", or "none": physics alone, ten
            times as fast, with no camera in the observation; for checking experts.
        perturb: `axis=level`, separated by commas, as `perturbations.AXES` lists them; empty for none.
        perturb_seed: seed of what a perturbation draws once.
        cameras: those of `obs_type` that are rendered, all by default; one is faster than two, and shows the same.
        film: `render` shows shadows and has 720 lines, which takes a CPU several times as long.
        action: `task` (the channels that the task's row names) or `full` (all seven, so that one policy can have all
            tasks).

    Raises:
        ValueError: no such task, obs_type, action, render_backend, camera, axis or level, an episode_length below 1,
            or a brick drawn too large for its bin.
    """

    metadata = {"render_modes": ["rgb_array"], "render_fps": FPS}
    render_mode = "rgb_array"

    num_copies = 1
    """Copies of the task in the simulator; `NativeVectorEnv` steps several."""

    def __init__(
        self,
        task: str = "brick_to_bin",
        obs_type: ObsType = "pixels",
        episode_length: Steps | None = None,
        light_robot: bool | None = None,
        render_backend: Annotated[str, Among((*SEEING, "none"))] = "auto",
        perturb: str = "",
        perturb_seed: Seed = 0,
        cameras: tuple[str, ...] | None = None,
        film: bool = False,
        action: ActionForm = TASK_ACTION,
    ):
        check_fields(ConstructSkillEnv.__init__, locals())
        row, self._perturbation = perturbed_task(task, perturb, perturb_seed, action)
        self._row = self._perturbation.told(row)
        self.task = task
        self.task_description = self._row.instruction
        self.obs_type = obs_type
        self._max_episode_steps = episode_length or self._row.horizon
        offered = OBS_TYPES[obs_type]
        if not set(offered).issuperset(cameras := offered if cameras is None else cameras) or not cameras:
            raise InputError(f"cameras must be some of {', '.join(offered)}, which {obs_type} has, not {cameras}.")
        self.cameras = () if render_backend == "none" else tuple(name for name in offered if name in cameras)
        self._settings = {
            "task": task,
            "episode_length": self._max_episode_steps,
            "obs_type": obs_type,
            "perturb": perturb,
            "perturb_seed": perturb_seed,
        }
        self._scene_kwargs = {
            "cameras": self.cameras,
            "light_robot": light_robot,
            "render_backend": render_backend,
            "perturbation": self._perturbation,
            "film": film,
        }
        self._env = None
        self._steps: int | None = None  # of the episode; None where none has begun
        self._recording = None
        image = spaces.Box(0, 255, (IMAGE_SIZE, IMAGE_SIZE, 3), np.uint8)
        space = {"pixels": spaces.Dict(dict.fromkeys(self.cameras, image))}
        if obs_type != "pixels":
            space["agent_pos"] = spaces.Box(-np.inf, np.inf, (len(state_names(obs_type)),), np.float32)
        self.observation_space = spaces.Dict(space)
        self.action_space = spaces.Box(*action_bounds(len(self._row.action_names)), dtype=np.float32)

    # Gymnasium

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[dict[str, Any], dict[str, Any]]:
        """Start an episode that is a function of `seed` and actions alone; unknown `options` are ignored."""
        super().reset(seed=seed)
        if seed is None:
            seed = int(self.np_random.integers(2**31))
        obs, info = self.begin(seed)
        self._pixel_rngs = {
            name: np.random.default_rng([seed, self._perturbation.seed, zlib.crc32(f"sensor {name}".encode())])
            for name in self.cameras
        }
        self._recording = recorder(evaluation_seed=seed, backend=self.backend, **self._settings)
        return self._observation(obs), self._info(info) | {"contract": json.dumps(self.contract)}

    def step(self, action: np.ndarray) -> tuple[dict[str, Any], float, bool, bool, dict[str, Any]]:
        """Advance 1/20 s.

        Raises:
            RuntimeError: before the first `reset`.
            ValueError: an action of another shape, or not finite.
        """
        obs, reward, terminated, truncated, info = self.advance(self.maniskill_action(action))
        terminated, info = bool(terminated[0]), self._info(info)
        if self._recording is not None:
            self._recording.add(action, info)
            if terminated or truncated:
                keep(self._recording)
                self._recording = None
        return self._observation(obs), float(reward[0]), terminated, truncated, info

    @one_thread()
    def render(self) -> np.ndarray:
        """A close-up of the scene, (H, W, 3) uint8. Raises as `step` does."""
        return self.started().render()[0].cpu().numpy()

    def close(self) -> None:
        if self._env is not None:
            self._env.close()
            self._env = self._steps = None

    @property
    def contract(self) -> dict[str, Any]:
        """What actions and observations mean, as `interface.describe_task` says: units, ranges, frames and cameras."""
        return describe_task(self._row, self.cameras, () if self.obs_type == "pixels" else state_names(self.obs_type))

    # For experts and recorders

    @one_thread()
    def privileged_state(self) -> dict[str, np.ndarray]:
        """The simulator's state, `contract.SIM_STATE` name to float32 array. Raises as `step` does."""
        state = self.started().privileged_state()
        return {name: value[0].cpu().numpy().astype(np.float32) for name, value in state.items()}

    @one_thread()
    def agent_state(self) -> np.ndarray:
        """The state, which `pixels` does not show, as `contract.state_names` names it: (8,) or (11,) float32.

        Raises as `step` does.
        """
        return self._agent_states()[0]

    @property
    def light_robot(self) -> bool:
        """Whether the robot is drawn with decimated meshes."""
        return self._ensure_env().light_robot

    @property
    def backend(self) -> str:
        """What simulates and what renders, such as "physx_cpu, sapien_cpu rendering"."""
        backend = self._ensure_env().backend
        return f"{backend.sim_backend}, {backend.render_backend} rendering"

    # ManiSkill

    def make_scene(self) -> gym.Env:
        """The task's ManiSkill environment; several copies in one simulator need a GPU.

        Raises:
            InputError: the task is another package's, whose scene cannot be imported.
            OSError: the simulator is not installed, or there is no device to render with.
        """
        try:
            from lerobot_constructskill.sim.register import register
        except ModuleNotFoundError as error:  # Gymnasium's worker processes drop the name of the package
            raise MachineError(remedy_of(error) or str(error)) from error

        register(self._row)
        _spare_imports()
        return gym.make(
            self._row.env_id,
            num_envs=self.num_copies,
            obs_mode="rgb" if self.cameras else "none",
            reward_mode="sparse",
            render_mode="rgb_array" if self.cameras else None,
            max_episode_steps=None,
            disable_env_checker=True,
            **self._scene_kwargs | ({} if self._row.plan is None else {"plan": self._row.plan}),
        ).unwrapped

    def _ensure_env(self) -> gym.Env:
        if self._env is None:
            self._env = self.make_scene()
        return self._env

    def started(self) -> gym.Env:
        """The ManiSkill environment of the episode that has begun.

        Raises:
            RuntimeError: before the first `reset`.
        """
        if self._steps is None:
            raise RuntimeError("Call reset() first: the simulator starts with the first reset.")
        return self._env

    @one_thread()
    def begin(self, seed: int | list[int]) -> tuple[dict[str, Any], dict[str, Any]]:
        """Reset the ManiSkill environment; return its observation and info, of all copies."""
        # PhysX keeps contacts over a reset and the next episode would show them; a new scene takes 0.04 s in a worker.
        result = self._ensure_env().reset(seed=seed, options={"reconfigure": bool(self._steps)})
        self._steps = 0
        return result

    @one_thread()
    def advance(self, action: np.ndarray) -> tuple[dict[str, Any], Any, Any, bool, dict[str, Any]]:
        """Step the ManiSkill environment by `action`, (7,) or (num_copies, 7); all copies are truncated together."""
        obs, reward, terminated, _, info = self.started().step(action)
        self._steps += 1
        return obs, reward, terminated, self._steps >= self._max_episode_steps, info

    def maniskill_action(self, action: np.ndarray) -> np.ndarray:
        """Convert an action, (A,), to ManiSkill's `pd_ee_delta_pose`, (7,); the scene clips it to [-1, 1]."""
        action = np.asarray(action, dtype=np.float32)
        names = self._row.action_names
        if action.shape != (len(names),) or not np.isfinite(action).all():
            raise InputError(f"An action is {len(names)} finite numbers {names}, not {action.tolist()}.")
        return normalised(action, names)

    @one_thread()
    def observations(self, obs: dict[str, Any]) -> dict[str, Any]:
        """The observation of every copy, arrays (num_copies, ...), without the noise of a perturbed sensor."""
        pictures = {name: obs["sensor_data"][name]["rgb"].cpu().numpy() for name in self.cameras}
        # Without the gaps of a fourth channel a picture is sent to another process faster. Channel by channel it is
        # copied faster than pixel by pixel.
        seen = {"pixels": {name: np.stack([*np.moveaxis(rgb, -1, 0)], axis=-1) for name, rgb in pictures.items()}}
        return seen if self.obs_type == "pixels" else seen | {"agent_pos": self._agent_states()}

    def _agent_states(self) -> np.ndarray:
        """The state of every copy, (num_copies, 8) or (num_copies, 11) float32."""
        scene: Any = self.started()
        parts = [scene.agent_state(), *([scene.force()] if state_names(self.obs_type) != STATE_NAMES else [])]
        return np.concatenate([part.cpu().numpy() for part in parts], axis=1).astype(np.float32)

    def _observation(self, obs: dict[str, Any]) -> dict[str, Any]:
        seen = self.observations(obs)
        pixels = {name: self._sensed(name, one[0]) for name, one in seen["pixels"].items()}
        return {name: one[0] for name, one in seen.items() if name != "pixels"} | {"pixels": pixels}

    def _sensed(self, camera: str, image: np.ndarray) -> np.ndarray:
        """`image`, (H, W, 3) uint8, as a noisy sensor sees it."""
        sigma = self._perturbation.amount("sensor")
        if not sigma:
            return image
        noisy = image + sigma * self._pixel_rngs[camera].standard_normal(image.shape)
        return np.clip(noisy.round(), 0, 255).astype(np.uint8)

    def _info(self, info: dict[str, Any]) -> dict[str, Any]:
        return {name: value[0].item() for name, value in public_info(info).items()}


def public_info(info: dict[str, Any]) -> dict[str, Any]:
    """The part of ManiSkill's info that users get, tensors (num_envs,): booleans, counts and the cost."""
    booleans = {name: value for name, value in info.items() if name.startswith("is_")}
    return {"is_success": info["success"], **booleans, **{name: info[name] for name in (*COUNTS, "cost")}}


@functools.cache
def _spare_imports() -> None:
    """In a worker process, exempt all present objects from garbage collection.

    ManiSkill collects garbage whenever a scene ends, and the million objects of imported modules took most of a
    reset. Other processes belong to the user, whose objects have to stay collectable.
    """
    if multiprocessing.parent_process() is not None:
        gc.collect()
        gc.freeze()


def resolve_rendering(light_robot: bool | None = None, render_backend: str = "auto") -> tuple[bool | None, str]:
    """Resolve `light_robot` and `render_backend` for this machine; without a simulator they stay as they are."""
    try:
        from lerobot_constructskill.sim.backends import best_render_backend
    except ModuleNotFoundError:
        return light_robot, render_backend
    backend = best_render_backend() if render_backend == "auto" else render_backend
    return (backend == "cpu" if light_robot is None else light_robot), backend
