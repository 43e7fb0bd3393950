"""Sub-environments that stand still after their episode's end, until somebody resets them."""

from collections.abc import Callable
from typing import Any

import gymnasium as gym

from lerobot_constructskill.lerobot_internals import NEW_ROLLOUT_OPTION, FreezeAfterEpisodeEnd


class FrozenAtEnd(FreezeAfterEpisodeEnd):
    """LeRobot's, which only an option of its own thaws, thawed by every `reset` of the vector environment.

    A vector environment hands its seed and options on, also where they are None; its autoreset, which has to find the
    episode as it ended, hands on nothing.
    """

    def reset(self, **given: Any) -> tuple[Any, dict[str, Any]]:
        if given:
            given["options"] = (given.get("options") or {}) | {NEW_ROLLOUT_OPTION: True}
        return super().reset(**given)


def frozen_at_end(make: Callable[[], gym.Env]) -> gym.Env:
    return FrozenAtEnd(make())
