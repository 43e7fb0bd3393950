"""ConstructSkill as a benchmark of vla-evaluation-harness (package `vla-eval`); eval.yaml names it."""

import os
from typing import Any, ClassVar

import constructskill_specs as specs
import numpy as np
from vla_eval.benchmarks.base import StepBenchmark, StepResult
from vla_eval.render import apply_env
from vla_eval.specs import IMAGE_RGB, LANGUAGE, STATE_EEF_POS_AA_GRIP, DimSpec
from vla_eval.types import Action, EpisodeResult, Observation, Task

from lerobot_constructskill.contract import (
    GRIPPER_OPEN,
    OBS_TYPES,
    REWARD_LIFTED,
    ROTATION,
    get_task,
    select_tasks,
)
from lerobot_constructskill.envs.actions import MANISKILL_CHANNELS
from lerobot_constructskill.envs.gym_env import ConstructSkillEnv, perturbed_task

OBS_TYPE = "pixels_agent_pos"


class ConstructSkillBenchmark(StepBenchmark):
    """Tasks of the contract table, with both cameras, the state and the instruction.

    Non-obvious behaviours: an action is in metres (and radians), not in [-1, 1], its gripper +1 open, -1 closed. It
    has the task's own numbers, or seven (three translations, three rotations, gripper) of which the task takes its
    own. Episode i starts from seed `seed` + i. Success ends an episode and counts once it has held for five steps;
    `lifted` is reported beside it.

    Args:
        tasks: what `--env.task` takes: tasks or suites with commas between.
        seed: seed of the first episode of every task.
        max_steps: horizon of every task; each task's own by default.
        perturb: `axis=level` with commas between, as `--env.perturb` takes it; of `language` and `wrong_task` the
            model is told what they say.
        perturb_seed: as `--env.perturb_seed`.
        light_robot: as `--env.light_robot`: which robot is drawn; a model's training data say which it has seen.
    """

    render_backends: ClassVar[frozenset[str]] = frozenset({"gpu", "cpu"})
    _render_backend: ClassVar[str] = "auto"

    def __init__(
        self,
        tasks: str = "bins",
        seed: int = 1000,
        max_steps: int | None = None,
        perturb: str = "",
        perturb_seed: int = 0,
        light_robot: bool | None = None,
    ):
        super().__init__()
        self._perturb, self._perturb_seed = perturb, perturb_seed
        self._rows = []
        for suite, rows in select_tasks(tasks).items():
            for row in rows:
                task, perturbation = perturbed_task(row.name, perturb, perturb_seed)
                self._rows.append((suite, perturbation.told(task)))
        self._seed, self._max_steps = seed, max_steps
        self._light_robot = light_robot
        self._env: ConstructSkillEnv | None = None

    @classmethod
    def configure_render(cls, mode: str) -> dict[str, str]:
        """Choose the renderer of environments still to be made; on a CPU one thread each for it and for torch.

        The harness's default is "gpu" wherever it runs: then a GPU renders if there is one, and else the CPU.
        """
        cls._render_backend = "cpu" if mode == "cpu" else "auto"
        threads = {name: os.environ.get(name, "1") for name in ("LP_NUM_THREADS", "OMP_NUM_THREADS")}
        return apply_env(threads) if mode == "cpu" else {}

    # Episodes

    def get_tasks(self) -> list[Task]:
        return [{"name": row.name, "suite": suite, "instruction": row.instruction} for suite, row in self._rows]

    def reset(self, task: Task) -> dict[str, Any]:
        """Start the episode of `task["episode_idx"]`, in the environment at hand if it is the task's."""
        if self._env is None or self._env.task != task["name"]:
            self.cleanup()
            self._env = ConstructSkillEnv(
                task["name"],
                OBS_TYPE,
                self._max_steps,
                self._light_robot,
                render_backend=self._render_backend,
                perturb=self._perturb,
                perturb_seed=self._perturb_seed,
            )
        observation, _ = self._env.reset(seed=self._seed + task.get("episode_idx", 0))
        self._recorder.record_video(observation["pixels"]["base"])
        return observation

    def step(self, action: Action) -> StepResult:
        """Advance 1/20 s.

        Raises:
            ValueError: an action of another length, or not finite.
        """
        command = self._command(np.asarray(action["actions"], dtype=np.float32).reshape(-1))
        observation, reward, terminated, truncated, info = self._env.step(command)
        result = StepResult(observation, reward, terminated or truncated, info)
        self._recorder.record_video(observation["pixels"]["base"])
        self._recorder.record_step(reward=reward, done=result.done, success=info["is_success"])
        return result

    def _command(self, action: np.ndarray) -> np.ndarray:
        """The task's own channels of an action."""
        if len(action) != len(MANISKILL_CHANNELS):
            return action
        return action[[MANISKILL_CHANNELS.index(name) for name in get_task(self._env.task).action_names]]

    def make_obs(self, raw_obs: dict[str, Any], task: Task) -> Observation:
        return {
            "images": dict(raw_obs["pixels"]),
            "state": raw_obs["agent_pos"],
            "task_description": task["instruction"],
        }

    def get_step_result(self, step_result: StepResult) -> EpisodeResult:
        success = bool(step_result.info.get("is_success", False))
        return {"success": success, "lifted": step_result.reward >= REWARD_LIFTED}

    # What the harness asks beforehand

    def get_metric_keys(self) -> dict[str, str]:
        return {"success": "mean", "lifted": "mean"}

    def get_metadata(self) -> dict[str, Any]:
        return {"max_steps": self._max_steps or max(row.horizon for _, row in self._rows)}

    def get_action_spec(self) -> dict[str, DimSpec]:
        turns = [name for name in self._rows[0][1].action_names if name in ROTATION]
        rotation = {"rotation": specs.rotation(turns)} if turns else {}
        return {"position": specs.POSITION, **rotation, "gripper": specs.GRIPPER}

    def get_observation_spec(self) -> dict[str, DimSpec]:
        cameras = dict.fromkeys(OBS_TYPES[OBS_TYPE], IMAGE_RGB)
        return cameras | {"state": STATE_EEF_POS_AA_GRIP, "language": LANGUAGE}

    def get_hold_action(self, last_action: Action | None) -> Action:
        """Stay where it is, the gripper as it was; repeating a displacement would go on moving."""
        hold = np.zeros(len(self._rows[0][1].action_names), dtype=np.float32)
        hold[-1] = GRIPPER_OPEN if last_action is None else np.asarray(last_action["actions"]).reshape(-1)[-1]
        return {"actions": hold}

    def render(self) -> np.ndarray | None:
        """A close-up of the scene, (H, W, 3) uint8; None before the first episode."""
        return None if self._env is None else self._env.render()

    def cleanup(self) -> None:
        if self._env is not None:
            self._env.close()
            self._env = None
