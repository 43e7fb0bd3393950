"""Many environments in a few processes, each stepped on its own."""

import os
import pickle
import signal
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import BrokenExecutor, Executor, Future, ProcessPoolExecutor
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from multiprocessing import get_context
from typing import Any

import numpy as np

from lerobot_constructskill.artifacts.pools import cores, die_with_parent
from lerobot_constructskill.envs.fork_server import start_fork_server
from lerobot_constructskill.envs.gym_env import ConstructSkillEnv
from lerobot_constructskill.errors import MachineError, full_traceback

PRELOADED = [
    "lerobot_constructskill.artifacts.ends_with_parent",
    "lerobot_constructskill.sim.register",
    "lerobot_constructskill.rollout.simulators",
]
"""What every worker imports."""

DIED = "A simulator's process died; if there was not enough memory, run fewer at once."


@dataclass(frozen=True)
class Step:
    """What an environment returned from `reset` or `step`.

    Args:
        seen: the observation.
        sim: privileged state, `contract.SIM_STATE` name to float32 array.
        done: whether the episode is over.
        info: as of `ConstructSkillEnv.step`.
        agent_state: proprioception, as `ConstructSkillEnv.agent_state`.
        backend: what simulates and renders, as `ConstructSkillEnv.backend`.
    """

    seen: dict[str, Any]
    sim: dict[str, np.ndarray]
    done: bool
    info: dict[str, Any]
    reward: float = 0.0
    agent_state: np.ndarray | None = None
    backend: str = ""


class Answers:
    """What environments return for what they were asked; they are at work until then.

    Args:
        shares: for each worker that was asked, its environments' answers by number.
    """

    def __init__(self, shares: Sequence[Future]):
        self._shares = shares

    def get(self) -> dict[int, Any]:
        """Wait for the answers, by number; in place of one stands the exception of an environment that raised.

        Raises:
            OSError: a worker died, for instance because memory ran out.
        """
        answers: dict[int, Any] = {}
        try:
            for share in self._shares:
                answers |= share.result()
        except BrokenExecutor:
            raise MachineError(DIED) from None
        return answers


class Simulators:
    """Environments, spread over worker processes; environment i lives in worker i % workers.

    `reset` and `step` take a value for each environment by number, and raise `OSError` where a worker has died.
    """

    def __init__(self, workers: Sequence[Executor]):
        self._workers = workers

    def reset(self, seeds: Mapping[int, int]) -> Answers:
        """Have an episode start in each named environment, number to seed; the answers are of type `Step`."""
        return self._ask(_reset, seeds)

    def step(self, actions: Mapping[int, np.ndarray]) -> Answers:
        """Have each named environment advance, number to action; the answers are of type `Step`."""
        return self._ask(_step, actions)

    def _ask(self, call: Callable[..., Any], arguments: Mapping[int, Any]) -> Answers:
        shares: list[dict[int, Any]] = [{} for _ in self._workers]
        for number, argument in arguments.items():
            shares[number % len(shares)][number] = argument
        try:
            asked = zip(self._workers, shares, strict=True)
            return Answers([worker.submit(_answer, call, own) for worker, own in asked if own])
        except BrokenExecutor:
            raise MachineError(DIED) from None


@contextmanager
def simulators(env_kwargs: Sequence[Mapping[str, Any]], n_workers: int | None = None) -> Iterator[Simulators]:
    """Open a `ConstructSkillEnv(**kwargs)` for each of `env_kwargs` in `n_workers` processes (one per core)."""
    start_fork_server(PRELOADED)
    context = get_context("forkserver")
    with ExitStack() as stack:
        workers = [
            stack.enter_context(ProcessPoolExecutor(1, context, _begin, (env_kwargs,)))
            for _ in range(min(len(env_kwargs), n_workers or cores()))
        ]
        yield Simulators(workers)


_env_kwargs: list[Mapping[str, Any]] = []
_environments: dict[int, ConstructSkillEnv] = {}
"""Of a worker process: arguments of all environments, and by number those that it has made."""


def _begin(env_kwargs: Sequence[Mapping[str, Any]]) -> None:
    """Prepare a worker process: it ends with its parent, ignores Ctrl-C, which its parent handles, and has one thread.

    Workers share the cores; more threads would stall each other.
    """
    import torch

    die_with_parent()
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    os.environ["LP_NUM_THREADS"] = "1"
    torch.set_num_threads(1)
    _env_kwargs.extend(env_kwargs)


def _answer(call: Callable[..., Any], arguments: Mapping[int, Any]) -> dict[int, Any]:
    """Call a function with each numbered environment and its argument."""
    return {number: _attempt(call, number, argument) for number, argument in arguments.items()}


def _reset(env: ConstructSkillEnv, seed: int) -> Step:
    seen, info = env.reset(seed=seed)
    return Step(seen, env.privileged_state(), False, info, 0.0, env.agent_state(), env.backend)


def _step(env: ConstructSkillEnv, action: np.ndarray) -> Step:
    seen, reward, terminated, truncated, info = env.step(action)
    return Step(seen, env.privileged_state(), terminated or truncated, info, reward, env.agent_state(), env.backend)


def _attempt(call: Callable[..., Any], number: int, argument: Any) -> Any:
    """What a call returns for an environment, which is made first if need be, or what it raises, as can be sent."""
    try:
        if number not in _environments:
            _environments[number] = ConstructSkillEnv(**_env_kwargs[number])
        return call(_environments[number], argument)
    except Exception as error:
        told = full_traceback(error)  # an exception leaves it behind when it leaves the process
        try:
            pickle.loads(pickle.dumps(error))
        except Exception:  # whatever a package's own exception may do
            error = RuntimeError(f"{type(error).__name__}: {error}")
        error.add_note(told)
        return error
