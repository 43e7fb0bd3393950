"""Starts the process that simulators' workers are forked from, so that no worker repeats its imports."""

from collections.abc import Sequence
from multiprocessing import forkserver


def start_fork_server(preload: Sequence[str]) -> None:
    """Start the fork server of this process, if none runs, and have it import the modules of `preload`.

    The server must not initialise CUDA: its workers would inherit that, and could use neither CUDA nor Vulkan. LeRobot
    imports diffusers, which asks torch for a GPU.
    """
    import lerobot_constructskill.sim  # noqa: F401  names Vulkan's drivers, which the server hands on

    forkserver.set_forkserver_preload(["lerobot_constructskill.envs.no_cuda", *preload])
    forkserver.ensure_running()
