"""`--env.type=constructskill`."""

import os
from dataclasses import dataclass
from functools import partial
from typing import Annotated, Any

import gymnasium as gym
from lerobot.configs import FeatureType, PolicyFeature
from lerobot.envs import EnvConfig

from lerobot_constructskill.bounds import Among, Range, Seed, Steps, check
from lerobot_constructskill.contract import (
    CAMERAS,
    FPS,
    IMAGE_SIZE,
    OBS_TYPES,
    PLANNED,
    TASK_ACTION,
    list_tasks,
    select_tasks,
    state_names,
)
from lerobot_constructskill.envs.freeze import LazyAsyncVectorEnv, SyncVectorEnv
from lerobot_constructskill.envs.gym_env import SEEING, ActionForm, ConstructSkillEnv, ObsType, perturbed_task
from lerobot_constructskill.envs.recording import FOLDER, recording_into
from lerobot_constructskill.envs.vector_env import NativeVectorEnv, check_unperturbed
from lerobot_constructskill.errors import InputError, as_field_error
from lerobot_constructskill.perturbations import Perturbation

VECTORIZATIONS = ("process", "native")


@EnvConfig.register_subclass("constructskill")
@dataclass
class ConstructSkillEnvConfig(EnvConfig):
    """ConstructSkill's tasks for `lerobot-train` and `lerobot-eval`.

    Args:
        task: a name in `contract.TASKS` or in `contract.SUITES`, or several separated by commas, whose actions
            must be the same.
        plan: a plan in `configs/plan` or a file: the wall that is built instead of a task.
        obs_type: `pixels` (the base camera), `pixels_agent_pos` (adds the wrist camera and the 8-number state, for
            policies that need them) or `pixels_agent_pos_force` (adds the force at the wrist to that state).
        episode_length: horizon of an evaluation episode in steps; the task's own by default.
        light_robot: draw the robot with decimated meshes; by default only where frames are rendered on a CPU.
            Training and evaluation should see the same robot.
        render_backend: "auto" (a GPU that can render, else the CPU), "gpu" or "cpu".
        vectorization: "process" (a simulator for each environment) or "native" (one for all, which needs a GPU for
            more than one environment).
        perturb: `axis=level`, separated by commas, as `perturbations.AXES` lists them, such as `camera=2,light=1`;
            LeRobot keeps the results under names that end in it.
        perturb_seed: seed of what a perturbation draws once.
        action: `task` (the channels of the task) or `full` (seven numbers in every task: translation in metres,
            rotation in radians, gripper), which one policy of tasks with and without rotations acts in.
    """

    task: str = "brick_to_bin"
    plan: str | None = None
    fps: Annotated[int, Range(FPS, FPS, unit="Hz, the control rate of every task")] = FPS
    obs_type: ObsType = "pixels"
    episode_length: Steps | None = None
    light_robot: bool | None = None
    render_backend: Annotated[str, Among(SEEING)] = "auto"
    vectorization: Annotated[str, Among(VECTORIZATIONS)] = "process"
    perturb: str = ""
    perturb_seed: Seed = 0
    action: ActionForm = TASK_ACTION

    def __post_init__(self):
        with as_field_error():
            check(self)
            if self.plan is not None:
                if self.task not in (type(self).task, f"{PLANNED}{self.plan}"):
                    raise InputError(f"The plan {self.plan} is a task of its own: leave out --env.task={self.task}.")
                self.task = f"{PLANNED}{self.plan}"
            if self.max_parallel_tasks != 1:
                raise InputError("max_parallel_tasks must be 1: LeRobot's threads would share one stateful policy.")
            if self.vectorization == "native":
                check_unperturbed(self.perturb)
            rows = list_tasks(self.task, self.action)
            for row in rows:
                perturbed_task(row.name, self.perturb, self.perturb_seed)
        image = PolicyFeature(FeatureType.VISUAL, (IMAGE_SIZE, IMAGE_SIZE, 3))
        cameras = {CAMERAS[name].key: image for name in OBS_TYPES[self.obs_type]}
        self.features = {"action": PolicyFeature(FeatureType.ACTION, (len(rows[0].action_names),)), **cameras}
        self.features_map = {name: name for name in self.features}
        if self.obs_type != "pixels":
            self.features["agent_pos"] = PolicyFeature(FeatureType.STATE, (len(state_names(self.obs_type)),))
            self.features_map["agent_pos"] = "observation.state"

    @property
    def gym_kwargs(self) -> dict[str, Any]:
        """Arguments of `ConstructSkillEnv`; `action` only where it is not the default, as in the digests of runs."""
        names = ("task", "obs_type", "episode_length", "light_robot", "render_backend", "perturb", "perturb_seed")
        acting = {} if self.action == TASK_ACTION else {"action": self.action}
        return {name: getattr(self, name) for name in names} | acting

    def create_envs(self, n_envs: int, use_async_envs: bool = False) -> dict[str, dict[int, gym.vector.VectorEnv]]:
        """`{suite: {task number: vector environment}}`; every sub-environment freezes after its episode's end."""
        label = Perturbation(self.perturb, self.perturb_seed).label
        return {
            suite + label: {i: self._vector_env(row.name, n_envs, use_async_envs) for i, row in enumerate(rows)}
            for suite, rows in select_tasks(self.task, self.action).items()
        }

    def _vector_env(self, task: str, n_envs: int, use_async_envs: bool) -> gym.vector.VectorEnv:
        kwargs = self.gym_kwargs | {"task": task}
        if self.vectorization == "native":
            return NativeVectorEnv(n_envs, **kwargs)
        make = partial(ConstructSkillEnv, **kwargs)
        if use_async_envs and n_envs > 1:
            return LazyAsyncVectorEnv([partial(recording_into, os.environ.get(FOLDER), make)] * n_envs, make())
        return SyncVectorEnv([make] * n_envs)
