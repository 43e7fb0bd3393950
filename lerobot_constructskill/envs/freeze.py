"""Vector environments whose sub-environments freeze at their episode's end, until the next `reset`."""

from collections.abc import Callable
from functools import cached_property
from typing import Any

import gymnasium as gym
import numpy as np

from lerobot_constructskill.envs.fork_server import start_fork_server
from lerobot_constructskill.lerobot_internals import (
    NEW_ROLLOUT_OPTION,
    FreezeAfterEpisodeEnd,
    _LazyAsyncVectorEnv,
)

PRELOADED = ("lerobot.envs.utils", "lerobot_constructskill.sim.register")
"""What every worker of LeRobot's vector environments imports."""


class FrozenAtEnd(FreezeAfterEpisodeEnd):
    """LeRobot's wrapper, which only LeRobot's own option thaws, thawed by every `reset` of the vector environment.

    A vector environment's `reset` passes seed and options, even if they are None. Its autoreset, which must find the
    episode as it ended, passes nothing.
    """

    def reset(self, **given: Any) -> tuple[Any, dict[str, Any]]:
        return super().reset(**thawing(**given) if given else {})


class StaysDone:
    """A vector environment in which an episode that has ended stays `terminated` or `truncated` until `reset`.

    Gymnasium's automatic reset, which a frozen sub-environment only pretends, would report every second step of it as
    the first of a new episode.
    """

    @cached_property
    def _ended(self) -> np.ndarray:
        """Whether each episode was terminated, and truncated: (2, num_envs)."""
        return np.zeros((2, self.num_envs), dtype=bool)

    def reset(self, **given: Any) -> tuple[Any, dict[str, Any]]:
        """Begin an episode in every environment, or in those of Gymnasium's `options["reset_mask"]`, (num_envs,)."""
        chosen = (given.get("options") or {}).get("reset_mask", slice(None))
        result = super().reset(**given)
        self._ended[:, chosen] = False
        return result

    def step(self, actions: np.ndarray) -> tuple[Any, np.ndarray, np.ndarray, np.ndarray, dict[str, Any]]:
        obs, reward, terminated, truncated, info = super().step(actions)
        self._ended |= terminated, truncated
        return obs, reward, *self._ended.copy(), info


class SyncVectorEnv(StaysDone, gym.vector.SyncVectorEnv):
    """Gymnasium's synchronous vector environment, of environments that freeze at their episode's end."""

    def __init__(self, env_fns: list[Callable[[], gym.Env]]):
        super().__init__([lambda fn=fn: FrozenAtEnd(fn()) for fn in env_fns])
        self.metadata = self.metadata | {"autoreset_mode": gym.vector.AutoresetMode.DISABLED}


class LazyAsyncVectorEnv(StaysDone, _LazyAsyncVectorEnv):
    """LeRobot's asynchronous vector environment, whose workers freeze by themselves, thawed by every `reset`.

    The workers are forked when they are first needed, from a server that has already made their imports.
    """

    def __init__(self, env_fns: list[Callable[[], gym.Env]], probe: gym.Env):
        metadata = probe.metadata | {"autoreset_mode": gym.vector.AutoresetMode.DISABLED}
        super().__init__(env_fns, probe.observation_space, probe.action_space, metadata)

    def _ensure(self) -> None:
        if self._env is None:
            start_fork_server(PRELOADED)
        super()._ensure()

    def reset(self, **given: Any) -> tuple[Any, dict[str, Any]]:
        return super().reset(**thawing(**given))


def thawing(seed: Any = None, options: dict[str, Any] | None = None) -> dict[str, Any]:
    """Arguments of a `reset`, with LeRobot's option that begins a new episode."""
    return {"seed": seed, "options": (options or {}) | {NEW_ROLLOUT_OPTION: True}}
