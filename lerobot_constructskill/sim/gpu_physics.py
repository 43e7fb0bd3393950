"""PhysX on a GPU, which steps several environments in one scene: what it needs, each refused in one sentence."""

from zipfile import BadZipFile

import sapien
from sapien import physx

from lerobot_constructskill.errors import InputError, MachineError, first_line

BACKENDS = ("gpu", "cuda", "physx_cuda")
"""ManiSkill's names of it."""


def steps_on_gpu(sim_backend: str, num_envs: int) -> bool:
    """Whether ManiSkill would take PhysX on a GPU."""
    return num_envs > 1 if sim_backend == "auto" else sim_backend.partition(":")[0] in BACKENDS


def enable_gpu_physics(num_envs: int, render_backend: str) -> None:
    """Load PhysX for the GPU into this process, where it is not yet loaded.

    Raises:
        InputError: the pictures are to be rendered on the CPU, which cannot see a scene that is on a GPU.
        MachineError: there is no GPU, its library cannot be had, or this process has had a scene on the CPU before.
    """
    if physx.is_gpu_enabled():
        return
    who = "This environment needs" if num_envs == 1 else f"{num_envs} environments in one simulator need"
    asked = f"{who} physics on a GPU"
    remedy = "or simulate each on the CPU (num_envs=1, sim_backend=auto; with LeRobot vectorization=process)"
    try:
        sapien.Device("cuda")
    except RuntimeError as error:
        raise MachineError(f"{asked}, and there is none ({error}): use a machine with one, {remedy}.") from None
    if render_backend in ("cpu", "sapien_cpu"):
        raise InputError(f"{asked}, where the CPU cannot render: use render_backend=gpu or none, {remedy}.")
    try:
        physx.enable_gpu()
    except (OSError, BadZipFile, RuntimeError) as error:
        if "only be enabled once" in str(error):
            said = "which must be the first scene of a process: start a new one"
            raise MachineError(f"{asked}, {said}, {remedy}.") from None
        raise MachineError(
            f"{asked}, and its library cannot be loaded ({first_line(error)}): SAPIEN fetches it from GitHub into "
            f"~/.sapien/physx/{physx.version()} when it is first used; put it there, {remedy}."
        ) from None
