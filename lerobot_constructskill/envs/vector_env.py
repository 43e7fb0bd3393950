"""Many environments in one natively vectorised simulator, as LeRobot wants a vector environment.

With PhysX on a GPU one scene steps and renders hundreds of environments at once; PhysX on a CPU knows only one.
Several environments have not yet run on a GPU. One environment is tested on the CPU: it equals `ConstructSkillEnv`.
"""

import json
import os
from collections.abc import Sequence
from numbers import Integral
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium.vector.utils import batch_space

from lerobot_constructskill.envs.gym_env import ConstructSkillEnv, public_info
from lerobot_constructskill.envs.recording import FOLDER
from lerobot_constructskill.errors import InputError


def check_unperturbed(perturb: str) -> None:
    """Raise InputError where a perturbation is asked of environments that share a simulator."""
    if perturb:
        raise InputError("Each environment draws its own perturbation; use vectorization=process with them.")


class NativeVectorEnv(gym.vector.VectorEnv):
    """`n_envs` copies of a task in one simulator.

    An environment whose episode has ended is frozen: until the next `reset` it repeats its last observation and info
    with reward 0, as LeRobot's `FreezeAfterEpisodeEnd` does. Every episode's initial state comes from its own seed,
    whatever the other environments do.

    Args:
        n_envs: how many; more than one needs a GPU.
        kwargs: those of `ConstructSkillEnv`.

    Raises:
        InputError: episodes are to be recorded or perturbed, which it cannot.
        OSError: there is no GPU for more than one, or no PhysX for it (on the first `reset`).
    """

    def __init__(self, n_envs: int, **kwargs: Any):
        if os.environ.get(FOLDER):
            raise InputError(f"${FOLDER} records one environment per simulator only; use vectorization=process.")
        check_unperturbed(kwargs.get("perturb", ""))
        self._single = ConstructSkillEnv(**kwargs)
        self.num_envs = self._single.num_copies = n_envs
        self.metadata = ConstructSkillEnv.metadata | {"autoreset_mode": gym.vector.AutoresetMode.DISABLED}
        self.render_mode = ConstructSkillEnv.render_mode
        self.single_observation_space = self._single.observation_space
        self.single_action_space = self._single.action_space
        self.observation_space = batch_space(self.single_observation_space, n_envs)
        self.action_space = batch_space(self.single_action_space, n_envs)
        self._done = np.zeros(n_envs, dtype=bool)
        self._last: tuple | None = None

    def reset(
        self, *, seed: int | Sequence[int] | None = None, options: dict[str, Any] | None = None
    ) -> tuple[dict[str, Any], dict[str, Any]]:
        """Start an episode in every environment; an integer seeds environment i with `seed + i`.

        Raises:
            InputError: there is not one seed for each environment, or only some are to be reset.
        """
        if "reset_mask" in (options or {}):
            raise InputError("Environments that share a simulator begin together: leave out reset_mask.")
        if isinstance(seed, Integral):
            super().reset(seed=int(seed))
            seed = range(seed, seed + self.num_envs)
        seeds = self.np_random.integers(2**31, size=self.num_envs) if seed is None else seed
        if len(seeds) != self.num_envs:
            raise InputError(f"{self.num_envs} environments need as many seeds, not {len(seeds)}.")
        obs, info = self._single.begin([int(one) for one in seeds])
        self._done[:] = False
        contract = np.full(self.num_envs, json.dumps(self._single.contract), dtype=object)
        return self._single.observations(obs), self._infos(info) | {"contract": contract}

    def step(self, actions: np.ndarray) -> tuple[dict[str, Any], np.ndarray, np.ndarray, np.ndarray, dict[str, Any]]:
        """Advance 1/20 s; `actions` are (n_envs, A) in metres.

        Raises:
            RuntimeError: before the first `reset`.
        """
        scaled = np.stack([self._single.maniskill_action(action) for action in actions])
        obs, reward, terminated, truncated, info = self._single.advance(scaled)
        outcome = reward.cpu().numpy(), terminated.cpu().numpy(), np.full(self.num_envs, truncated)
        obs, reward, terminated, truncated, info = _keep(
            self._last, (self._single.observations(obs), *outcome, self._infos(info)), self._done
        )
        self._last = obs, np.zeros_like(reward), terminated, truncated, info
        self._done = terminated | truncated
        return obs, reward, terminated, truncated, info

    def render(self) -> tuple[np.ndarray, ...]:
        """A close-up of every environment, each (H, W, 3) uint8.

        Raises:
            RuntimeError: before the first `reset`.
        """
        return tuple(self._single.started().render().cpu().numpy())

    def call(self, name: str, *args: Any, **kwargs: Any) -> tuple[Any, ...]:
        """The attribute or method `name` of every environment."""
        if name == "render":
            return self.render()
        value = getattr(self._single, name)
        return (value(*args, **kwargs) if callable(value) else value,) * self.num_envs

    def get_attr(self, name: str) -> tuple[Any, ...]:
        return self.call(name)

    def close_extras(self, **kwargs: Any) -> None:
        self._single.close()

    def _infos(self, info: dict[str, Any]) -> dict[str, np.ndarray]:
        return {name: value.cpu().numpy() for name, value in public_info(info).items()}


def _keep(old: Any, new: Any, frozen: np.ndarray) -> Any:
    """Replace the rows of `new` where `frozen` by those of `old`, in tuples and dicts of arrays."""
    if not frozen.any():
        return new
    if isinstance(new, tuple):
        return tuple(_keep(a, b, frozen) for a, b in zip(old, new, strict=True))
    if isinstance(new, dict):
        return {name: _keep(old[name], value, frozen) for name, value in new.items()}
    return np.where(frozen.reshape(-1, *[1] * (new.ndim - 1)), old, new)
