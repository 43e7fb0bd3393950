"""Sub-environments that stand still after their episode's end, until somebody resets them."""

from collections.abc import Callable
from typing import Any

import gymnasium as gym

from lerobot_constructskill.envs.fork_server import start_fork_server
from lerobot_constructskill.lerobot_internals import (
    NEW_ROLLOUT_OPTION,
    FreezeAfterEpisodeEnd,
    _LazyAsyncVectorEnv,
)

PRELOADED = ("lerobot.envs.utils", "lerobot_constructskill.sim.register")
"""What every worker of LeRobot's vector environments imports."""


class FrozenAtEnd(FreezeAfterEpisodeEnd):
    """LeRobot's, which only an option of its own thaws, thawed by every `reset` of the vector environment.

    A vector environment hands its seed and options on, also where they are None; its autoreset, which has to find the
    episode as it ended, hands on nothing.
    """

    def reset(self, **given: Any) -> tuple[Any, dict[str, Any]]:
        return super().reset(**thawing(**given) if given else {})


class LazyAsyncVectorEnv(_LazyAsyncVectorEnv):
    """LeRobot's, whose workers freeze by themselves, thawed by every `reset` too.

    The workers are forked when they are first needed, from a server that has imported what they need.
    """

    def _ensure(self) -> None:
        start_fork_server(PRELOADED)
        super()._ensure()

    def reset(self, **given: Any) -> tuple[Any, dict[str, Any]]:
        return super().reset(**thawing(**given))


def thawing(seed: Any = None, options: dict[str, Any] | None = None) -> dict[str, Any]:
    """What a `reset` is given, with LeRobot's own word that an episode is to begin."""
    return {"seed": seed, "options": (options or {}) | {NEW_ROLLOUT_OPTION: True}}


def frozen_at_end(make: Callable[[], gym.Env]) -> gym.Env:
    return FrozenAtEnd(make())
