"""What renders on this machine. SAPIEN alone: ManiSkill takes seconds to import."""

import sapien


def best_render_backend() -> str:
    """ManiSkill's "gpu" where a GPU can render, else "cpu"."""
    try:
        return "gpu" if sapien.Device("cuda").can_render() else "cpu"
    except RuntimeError:
        return "cpu"
