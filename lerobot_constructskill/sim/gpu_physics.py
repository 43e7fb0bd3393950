"""PhysX on a GPU, which steps several environments in one simulator: what it needs, each refused in one sentence."""

from zipfile import BadZipFile

import sapien
from sapien import physx

from lerobot_constructskill.errors import InputError, MachineError, first_line

BACKENDS = ("gpu", "cuda", "physx_cuda")
"""ManiSkill's names of it."""

_WANTED = "Several environments in one simulator, or sim_backend=gpu, need a GPU"
_INSTEAD = "use num_envs=1 and sim_backend=auto, or a process each, as --env.vectorization=process does"


def steps_on_gpu(sim_backend: str, num_envs: int) -> bool:
    """Whether ManiSkill would take PhysX on a GPU."""
    return num_envs > 1 if sim_backend == "auto" else sim_backend.partition(":")[0] in BACKENDS


def enable_gpu_physics(renders_on_cpu: bool) -> None:
    """Load PhysX for the GPU into this process, where it is not loaded yet.

    Raises:
        InputError: the pictures are to be rendered on a CPU, which cannot see a scene that is on a GPU.
        MachineError: there is no GPU, its library cannot be had, or this process has simulated on the CPU before.
    """
    try:
        sapien.Device("cuda")
    except RuntimeError as error:
        raise MachineError(f"{_WANTED}, and there is none ({error}): {_INSTEAD}.") from None
    if renders_on_cpu:
        raise InputError(f"{_WANTED} that renders them too: use render_backend=gpu or none, or {_INSTEAD}.")
    if physx.is_gpu_enabled():
        return
    try:
        physx.enable_gpu()
    except (OSError, BadZipFile, RuntimeError) as error:
        if "only be enabled once" in str(error):
            said = f"{_WANTED}, and must be the first simulator of a process: start a new one, or {_INSTEAD}."
            raise MachineError(said) from None
        raise MachineError(
            f"{_WANTED}, and SAPIEN's library for it cannot be loaded ({first_line(error)}): SAPIEN fetches it from "
            f"GitHub into ~/.sapien/physx/{physx.version()} when it is first used; put it there, or {_INSTEAD}."
        ) from None
