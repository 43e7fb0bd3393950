"""Pools of workers behind one `submit`: this process, worker processes, or Ray."""

import ctypes
import os
import signal
import sys
import threading
from collections.abc import Callable, Iterator
from concurrent.futures import BrokenExecutor, Future, ProcessPoolExecutor
from contextlib import contextmanager
from multiprocessing import get_context, parent_process

from lerobot_constructskill.errors import InputError, MachineError

EXECUTORS = ("processes", "ray")

PR_SET_PDEATHSIG = 1

DIED = "A worker process died, perhaps out of memory; the same command continues with what is finished."

type Submit = Callable[..., Future]


def cores() -> int:
    """How many cores this process may use: a container or `taskset` can hold it to fewer than the machine has."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


@contextmanager
def open_pool(executor: str, workers: int) -> Iterator[Submit]:
    """Yield `submit(function, *arguments) -> Future`; leaving waits for what still runs.

    If the block raises, what has not begun is dropped.

    Raises:
        OSError: a worker process died.
        ValueError: `ray` was asked for and is not installed.
    """
    if executor == "ray":
        pool = _ray(workers)
    elif workers == 1:
        pool = _inline()
    else:
        pool = _processes(workers)
    with pool as submit:
        yield submit


@contextmanager
def _inline() -> Iterator[Submit]:
    def submit(function, *arguments) -> Future:
        future = Future()
        future.set_result(function(*arguments))
        return future

    yield submit


@contextmanager
def _processes(workers: int) -> Iterator[Submit]:
    try:
        with ProcessPoolExecutor(workers, get_context("spawn"), initializer=_settle) as pool:
            try:
                yield pool.submit
            except BaseException:
                pool.shutdown(cancel_futures=True)
                raise
    except BrokenExecutor:
        raise MachineError(DIED) from None


def be_killed_with_parent() -> None:
    """Have the kernel kill this process when the one that forked it ends, however that ends (Linux alone)."""
    if sys.platform == "linux":
        ctypes.CDLL(None).prctl(PR_SET_PDEATHSIG, signal.SIGKILL)


def _settle() -> None:
    """Initialise a worker: one thread, no Ctrl-C (its parent handles that), and an end together with its parent."""
    for name in ("OMP_NUM_THREADS", "LP_NUM_THREADS"):
        os.environ.setdefault(name, "1")
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    die_with_parent()


def die_with_parent() -> None:
    """End this worker process as soon as its parent has ended."""
    threading.Thread(target=_outlive_no_parent, daemon=True).start()


def _outlive_no_parent() -> None:
    parent_process().join()
    os._exit(1)


@contextmanager
def _ray(workers: int) -> Iterator[Submit]:
    """Ray on this machine, or on the cluster of `$RAY_ADDRESS`."""
    try:
        import ray
    except ImportError:
        raise InputError("Ray is not installed; uv pip install 'lerobot_env_constructskill[distributed]'.") from None
    here = {} if "RAY_ADDRESS" in os.environ else {"address": "local", "num_cpus": workers, "include_dashboard": False}
    ray.init(log_to_driver=False, logging_level="error", **here)
    try:
        yield lambda function, *arguments: ray.remote(function).remote(*arguments).future()
    except ray.exceptions.RayTaskError as error:
        raise error.cause from None
    except ray.exceptions.RayError as error:
        raise MachineError(f"{DIED} (Ray: {' '.join(str(error).split())[:300]})") from error
    finally:
        ray.shutdown()
