"""Mixed precision stays out of the simulator."""

from collections.abc import Callable

import torch


def outside_autocast[**P, R](method: Callable[P, R]) -> Callable[P, R]:
    """Have a method compute in full precision, whatever autocast surrounds its call.

    With `use_amp`, `lerobot-eval` steps its environments under the same autocast as the policy.
    """
    for device in ("cpu", "cuda"):
        method = torch.autocast(device, enabled=False)(method)
    return method
