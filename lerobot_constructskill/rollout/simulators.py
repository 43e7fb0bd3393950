"""Many environments in a few processes, each stepped on its own."""

import multiprocessing
import os
import pickle
import signal
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from multiprocessing.connection import Connection
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
    """What an environment returned from `reset` or `step`, with its privileged state and its proprioception."""

    seen: dict[str, Any]
    sim: dict[str, np.ndarray]
    done: bool
    info: dict[str, Any]
    reward: float = 0.0
    agent_state: np.ndarray | None = None


class Simulators:
    """Environments, spread over worker processes; environment i lives in worker i % workers.

    Every method takes a mapping from an environment's number and answers with one, in which an environment that raised
    has its exception. They raise `OSError` where a worker died, for want of memory for instance.
    """

    def __init__(self, workers: Sequence[Connection]):
        self._workers = workers

    def reset(self, seeds: Mapping[int, int]) -> dict[int, Step | Exception]:
        """Start an episode in each named environment: number to seed."""
        return self._ask("reset", seeds)

    def step(self, actions: Mapping[int, np.ndarray]) -> dict[int, Step | Exception]:
        """Advance each named environment: number to action."""
        return self._ask("step", actions)

    def backend(self, number: int) -> str:
        """What simulates and renders an environment that has been reset."""
        return self._ask("backend", {number: None})[number]

    def _ask(self, verb: str, arguments: Mapping[int, Any]) -> dict[int, Any]:
        shares = [{} for _ in self._workers]
        for number, argument in arguments.items():
            shares[number % len(shares)][number] = argument
        asked = [(worker, share) for worker, share in zip(self._workers, shares, strict=True) if share]
        answers: dict[int, Any] = {}
        try:
            for worker, share in asked:
                worker.send((verb, share))
            for worker, _ in asked:
                answers |= worker.recv()
        except (EOFError, ConnectionError):
            raise MachineError(DIED) from None
        return answers


@contextmanager
def simulators(env_kwargs: Sequence[Mapping[str, Any]], n_workers: int | None = None) -> Iterator[Simulators]:
    """Open a `ConstructSkillEnv(**kwargs)` for each of `env_kwargs` in `n_workers` processes (one per core)."""
    context = multiprocessing.get_context("forkserver")
    start_fork_server(PRELOADED)
    n_workers = min(len(env_kwargs), n_workers or cores())
    processes, connections = [], []
    try:
        for _ in range(n_workers):
            ours, theirs = context.Pipe()
            process = context.Process(target=_work, args=(theirs, env_kwargs), daemon=True)
            process.start()
            theirs.close()
            processes.append(process)
            connections.append(ours)
        yield Simulators(connections)
    finally:
        for connection in connections:
            connection.close()
        for process in processes:
            process.join(timeout=10)
            process.kill()


def _work(connection: Connection, env_kwargs: Sequence[Mapping[str, Any]]) -> None:
    """Serve environments until the other side hangs up."""
    die_with_parent()
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C reaches all of them; the other side handles it and hangs up
    _use_one_thread()
    envs: dict[int, ConstructSkillEnv] = {}

    def answer(verb: str, number: int, argument: Any) -> Any:
        if number not in envs:
            envs[number] = ConstructSkillEnv(**env_kwargs[number])
        return _VERBS[verb](envs[number], argument)

    while True:
        try:
            verb, arguments = connection.recv()
            connection.send({number: _attempt(answer, verb, number, one) for number, one in arguments.items()})
        except (EOFError, ConnectionError):
            break
    for env in envs.values():
        env.close()


def _use_one_thread() -> None:
    """Workers share the cores; threads of theirs would stall each other."""
    import torch

    os.environ["LP_NUM_THREADS"] = "1"
    torch.set_num_threads(1)


def _reset(env: ConstructSkillEnv, seed: int) -> Step:
    seen, info = env.reset(seed=seed)
    return Step(seen, env.privileged_state(), False, info, 0.0, env.agent_state())


def _step(env: ConstructSkillEnv, action: np.ndarray) -> Step:
    seen, reward, terminated, truncated, info = env.step(action)
    return Step(seen, env.privileged_state(), terminated or truncated, info, reward, env.agent_state())


_VERBS = {"reset": _reset, "step": _step, "backend": lambda env, _: env.backend}


def _attempt(call: Callable[..., Any], *arguments: Any) -> Any:
    """What a call returns, or what it raises, in a form that can be sent."""
    try:
        return call(*arguments)
    except Exception as error:
        told = full_traceback(error)  # an exception leaves it behind when it leaves the process
        try:
            pickle.loads(pickle.dumps(error))
        except Exception:  # whatever a package's own exception may do
            error = RuntimeError(f"{type(error).__name__}: {error}")
        error.add_note(told)
        return error
