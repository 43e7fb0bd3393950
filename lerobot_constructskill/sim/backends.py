"""What this machine can simulate and render with, each lack refused in one sentence. SAPIEN alone is imported."""

from zipfile import BadZipFile

import sapien
from sapien import physx

from lerobot_constructskill.errors import InputError, MachineError, first_line

NO_DEVICE = ("vk::", "vulkan", "rendering device", "physical device")
"""What SAPIEN's errors say, in lower case, where there is nothing to render with."""

GPU_PHYSICS = ("gpu", "cuda", "physx_cuda")
"""ManiSkill's names of PhysX on a GPU, which steps several environments in one simulator."""

_WANTED = "Several environments in one simulator, or sim_backend=gpu, need a GPU"
_INSTEAD = "use num_envs=1 and sim_backend=auto, or a process each, as --env.vectorization=process does"


def best_render_backend() -> str:
    """ManiSkill's "gpu" where a GPU can render, else "cpu"."""
    try:
        return "gpu" if sapien.Device("cuda").can_render() else "cpu"
    except RuntimeError:
        return "cpu"


def machine_lacks(error: RuntimeError) -> MachineError | None:
    """What to tell a user of SAPIEN's error where the machine is the cause; None where it is not."""
    said = str(error).lower()
    if "window" in said:
        return MachineError(
            f"render_mode=human needs a display and a GPU that renders to it ({error}): use rgb_array."
        )
    if any(word in said for word in NO_DEVICE):
        return MachineError(
            f"There is no Vulkan device to render with ({error}); `constructskill-doctor` says what is missing."
        )
    return None


def steps_on_gpu(sim_backend: str, num_envs: int) -> bool:
    """Whether ManiSkill would take PhysX on a GPU."""
    return num_envs > 1 if sim_backend == "auto" else sim_backend.partition(":")[0] in GPU_PHYSICS


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
        lack = (
            "must be the first simulator of a process: start a new one"
            if "only be enabled once" in str(error)
            else f"SAPIEN's library for it cannot be loaded ({first_line(error)}): SAPIEN fetches it from GitHub into "
            f"~/.sapien/physx/{physx.version()} when it is first used; put it there"
        )
        raise MachineError(f"{_WANTED}, and {lack}, or {_INSTEAD}.") from None
