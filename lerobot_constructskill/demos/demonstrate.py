"""Runs one demonstration: an expert acts in an environment under noise, and every frame is kept."""

from collections.abc import Callable
from typing import Any

import numpy as np

from lerobot_constructskill.contract import CAMERAS
from lerobot_constructskill.demos.expert import Expert, Phase, PrivilegedState
from lerobot_constructskill.demos.noise import NoiseConfig, execute
from lerobot_constructskill.envs.gym_env import ConstructSkillEnv


def demonstrate(
    env: ConstructSkillEnv,
    expert: Expert,
    noise: NoiseConfig,
    seed: int,
    labels: str = "clean",
    stop_at_success: bool = True,
    watch: Callable[[Phase | None, dict[str, Any]], None] | None = None,
) -> tuple[list[dict[str, Any]], bool]:
    """Run one attempt from the initial state of `seed`, whose noise is a function of `seed` too.

    Args:
        labels: one of `settings.LABELS`: what `action` is.
        stop_at_success: whether it ends with the placement, or when the expert has finished.
        watch: called before every step with the phase it belongs to and the observation, and at the end with None and
            the last observation.

    Returns:
        The frames, in the columns of `columns.demonstration_features`, and whether the object was placed. A frame
        holds the observation before its action, and the reward and outcome after it.
    """
    rng = np.random.default_rng(seed)
    obs, _ = env.reset(seed=seed)
    sim = env.privileged_state()
    progress = expert.start(PrivilegedState(**sim))
    frames, success, is_over = [], False, False
    while not is_over:
        state = PrivilegedState(**sim)
        clean, phase, progress = expert.act(state, progress)
        if watch:
            watch(phase, obs)
        executed = execute(clean, phase, noise, rng)
        before = seen(obs["pixels"], env.agent_state(), sim)
        obs, reward, success, truncated, _ = env.step(executed)
        is_over = progress is None or truncated or (success and stop_at_success)
        sim = env.privileged_state()
        label = expert.advise(state).action if labels == "advice" else clean if labels == "clean" else executed
        frames.append(before | decided(label, clean, executed, phase, seed) | came_of_it(reward, success, is_over))
    if watch:
        watch(None, obs)
    return frames, success


def seen(pixels: dict[str, np.ndarray], agent_state: np.ndarray, sim: dict[str, np.ndarray]) -> dict[str, Any]:
    """The columns that are known before a step: pictures, proprioception and simulator state."""
    return {
        **{CAMERAS[name].key: image for name, image in pixels.items()},
        "observation.state": agent_state,
        **{f"sim.{name}": value for name, value in sim.items()},
    }


def decided(label: np.ndarray, clean: np.ndarray, executed: np.ndarray, phase: Phase, seed: int) -> dict[str, Any]:
    """The columns of the step's label, its executed action, noise, phase and seed."""
    return {
        "action": label,
        "dart.executed_action": executed,
        "dart.noise": executed[:3] - clean[:3],
        "phase": str(phase),
        "sim.seed": np.array([seed], dtype=np.int64),
    }


def came_of_it(reward: float, success: bool, is_over: bool) -> dict[str, Any]:
    """The columns of the step's reward and outcome."""
    return {
        "next.reward": np.array([reward], dtype=np.float32),
        "next.success": np.array([success]),
        "next.done": np.array([is_over]),
    }
