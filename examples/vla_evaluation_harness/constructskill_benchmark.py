"""ConstructSkill as a benchmark of vla-evaluation-harness (package `vla-eval`); eval.yaml names it."""

import os
from dataclasses import replace
from typing import Any, ClassVar

import constructskill_specs as specs
import numpy as np
from vla_eval.benchmarks.base import StepBenchmark, StepResult
from vla_eval.render import apply_env
from vla_eval.specs import IMAGE_RGB, LANGUAGE, STATE_EEF_POS_AA_GRIP, DimSpec
from vla_eval.types import Action, EpisodeResult, Observation, Task

from lerobot_constructskill.bounds import check_fields
from lerobot_constructskill.contract import (
    FULL_ACTION,
    GRIPPER_OPEN,
    OBS_TYPES,
    REWARD_LIFTED,
    ROTATION,
    TASK_ACTION,
    select_tasks,
)
from lerobot_constructskill.envs.gym_env import ActionForm, ConstructSkillEnv, perturbed_task
from lerobot_constructskill.errors import InputError

OBS_TYPE = "pixels_agent_pos"


class ConstructSkillBenchmark(StepBenchmark):
    """Tasks of the contract table, with both cameras, the state and the instruction.

    Non-obvious behaviours: an action is in metres (and radians), not in [-1, 1], its gripper +1 open, -1 closed. It
    has the task's own numbers, or seven (three translations, three rotations, gripper) of which the task takes its
    own; with `action="full"` it has the seven in every task. Episode i starts from seed `seed` + i. Success ends an
    episode and counts once it has held for five steps; `lifted` is reported beside it.

    Args:
        tasks: what `--env.task` takes: tasks or suites with commas between.
        seed: seed of the first episode of every task.
        max_steps: horizon of every task; each task's own by default.
        perturb: `axis=level` with commas between, as `--env.perturb` takes it; of `language` and `wrong_task` the
            model is told what they say.
        perturb_seed: as `--env.perturb_seed`.
        light_robot: as `--env.light_robot`: which robot is drawn; a model's training data say which it has seen.
        action: as `--env.action`: `task` or `full`, with which one model can have tasks whose own actions differ.
        action_length: how many numbers the model sends; the harness fills it in where the server says so in its
            `observation_params`, as model_server.py does.

    Raises:
        InputError: no such tasks, action or perturbation, or an action_length that these tasks do not take.
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
        action: ActionForm = TASK_ACTION,
        action_length: int | None = None,
    ):
        super().__init__()
        check_fields(ConstructSkillBenchmark.__init__, {"action": action})
        self._action = action
        self._perturb, self._perturb_seed = perturb, perturb_seed
        self._rows = []
        for suite, rows in select_tasks(tasks, action).items():
            for row in rows:
                task, perturbation = perturbed_task(row.name, perturb, perturb_seed, action)
                self._rows.append((suite, perturbation.told(task)))
        self._names = self._rows[0][1].action_names  # of every row: `select_tasks` refuses others
        if action_length is not None:
            self._check_length(action_length)
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
                action=self._action,
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
        """The tasks' own channels of an action."""
        self._check_length(len(action))
        return action if len(action) == len(self._names) else action[[FULL_ACTION.index(name) for name in self._names]]

    def _check_length(self, count: int) -> None:
        taken = dict.fromkeys((self._names, FULL_ACTION))
        if count not in map(len, taken):
            raise InputError(
                f"The model sends {count} numbers a step, but these tasks take "
                f"{' or '.join(f'{len(names)} {names}' for names in taken)}, which `action: full` gives to every task."
            )

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
        turns = [name for name in self._names if name in ROTATION]
        if not turns:
            return {"position": specs.POSITION, "gripper": specs.GRIPPER}
        # A model of seven numbers has all three rotations, of which a task takes its own.
        taken = frozenset(specs.rotation(names).format for names in (turns, ROTATION))
        rotation = replace(specs.rotation(turns), accepts=taken)
        return {"position": specs.POSITION, "rotation": rotation, "gripper": specs.GRIPPER}

    def get_observation_spec(self) -> dict[str, DimSpec]:
        cameras = dict.fromkeys(OBS_TYPES[OBS_TYPE], IMAGE_RGB)
        return cameras | {"state": STATE_EEF_POS_AA_GRIP, "language": LANGUAGE}

    def get_hold_action(self, last_action: Action | None) -> Action:
        """Stay where it is, the gripper as it was; repeating a displacement would go on moving."""
        hold = np.zeros(len(self._names), dtype=np.float32)
        hold[-1] = GRIPPER_OPEN if last_action is None else np.asarray(last_action["actions"]).reshape(-1)[-1]
        return {"actions": hold}

    def render(self) -> np.ndarray | None:
        """A close-up of the scene, (H, W, 3) uint8; None before the first episode."""
        return None if self._env is None else self._env.render()

    def cleanup(self) -> None:
        if self._env is not None:
            self._env.close()
            self._env = None
