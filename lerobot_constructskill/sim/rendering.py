"""What this machine can simulate and render with. SAPIEN alone: ManiSkill takes seconds to import."""

import sapien

from lerobot_constructskill.errors import MachineError

NO_DEVICE = ("vk::", "vulkan", "rendering device", "physical device")
"""What SAPIEN's errors say, in lower case, where there is nothing to render with."""


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
