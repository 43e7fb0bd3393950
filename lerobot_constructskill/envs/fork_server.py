"""The process that simulators' workers are forked from: what it has imported, no worker imports again."""

import os
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from multiprocessing import forkserver

NVML_CHECK = "PYTORCH_NVML_BASED_CUDA_CHECK"
"""With it, torch asks the driver's NVML whether there is a GPU, and does not initialise CUDA for the answer."""


def start_fork_server(preload: Sequence[str]) -> None:
    """Start the fork server of this process, if none runs, and have it import the modules of `preload`.

    The server must not initialise CUDA: its workers would inherit that, and could use neither CUDA nor Vulkan. LeRobot
    imports diffusers, which asks torch for a GPU.
    """
    import lerobot_constructskill.sim  # noqa: F401  names Vulkan's drivers, which the server hands on

    forkserver.set_forkserver_preload(list(preload))
    with _set(NVML_CHECK, "1"):
        forkserver.ensure_running()


@contextmanager
def _set(name: str, value: str) -> Iterator[None]:
    before = os.environ.get(name)
    os.environ[name] = value
    try:
        yield
    finally:
        if before is None:
            del os.environ[name]
        else:
            os.environ[name] = before
