"""The number format that a backbone computes in: what a device does natively, and what `auto` means on it."""

import os
from collections.abc import Iterator
from contextlib import contextmanager

import torch

from lerobot_constructskill.errors import InputError, MachineError

PRECISIONS = ("float32", "bfloat16")

RUNTIMES = ("openvino", "torch")
"""Libraries that may compute a backbone's features: OpenVINO on a CPU, or PyTorch."""

AUTO = "auto"
"""The precision of the feature set or checkpoint. Without either, the fastest that the device does natively."""

ISA_CAP = "ONEDNN_MAX_CPU_ISA"
"""Environment variable that keeps the kernels of PyTorch and OpenVINO from newer instructions than a CPU may have."""

WITHOUT_BFLOAT16 = ("SSE41", "AVX", "AVX2", "AVX2_VNNI", "AVX2_VNNI_2", "AVX512_CORE", "AVX512_CORE_VNNI")
"""Values of `ISA_CAP` whose instruction sets do not multiply in bfloat16 (oneDNN, "CPU Dispatcher Control")."""


def native_precision(device: torch.device | str = "cpu") -> str:
    """Return the fastest precision that a device does natively.

    A CPU does bfloat16 with AVX512-BF16 or AMX. Others emulate it, slower than they do float32: with OpenVINO 26 times
    slower on two cores of an AMD EPYC whose kernels are capped, 60 times on a Xeon without it.
    """
    kind = torch.device(device).type
    if kind == "cuda":
        native = torch.cuda.is_bf16_supported(including_emulation=False)
    else:
        native = kind == "cpu" and _cpu_multiplies_bfloat16()
    return "bfloat16" if native else "float32"


def resolve_precision(asked: str, device: torch.device | str, made_in: str | None = None) -> str:
    """Return what `auto` means on a device, or for features that were `made_in` one precision already.

    Raises:
        ValueError: `asked` is neither `auto` nor a precision, and the message lists what there is.
    """
    if asked not in (AUTO, *PRECISIONS):
        raise InputError(f"backbone_precision must be one of {', '.join((AUTO, *PRECISIONS))}, got '{asked}'.")
    return (made_in or native_precision(device)) if asked == AUTO else asked


class NotNativeError(MachineError, ValueError):
    """A device would have to emulate a precision. Another machine may not, so this is no result of a run."""


def check_native(precision: str, device: torch.device | str) -> None:
    """Refuse a precision that a device would have to emulate.

    Raises:
        NotNativeError: the device does not do it natively.
    """
    if not is_native(precision, device):
        raise NotNativeError(
            f"This {torch.device(device).type} can only emulate {precision}, up to 60 times slower than float32: use "
            f"backbone_precision=float32, with which what was made in {precision} runs as well and logs "
            "how far its features drift."
        )


def is_native(precision: str, device: torch.device | str) -> bool:
    return precision in ("float32", native_precision(device))


def _cpu_multiplies_bfloat16() -> bool:
    if os.environ.get(ISA_CAP, "").upper() in WITHOUT_BFLOAT16:
        return False
    # Since 2.11 torch has this as `get_capabilities`; LeRobot takes 2.7 as well. Whatever has AMX has it for bfloat16.
    return torch.cpu._is_avx512_bf16_supported() or torch.cpu._is_amx_tile_supported()


@contextmanager
def computing_in(precision: str, device: torch.device) -> Iterator[None]:
    """Compute in a precision, whatever the code around has chosen by autocast or by TF32.

    LeRobot wraps a policy in autocast where `use_amp` is true. Its commands also switch on TF32, in which a GPU
    multiplies numbers of float32 with 10 bits of mantissa instead of 23.
    """
    flags = (torch.backends.cuda.matmul, torch.backends.cudnn) if device.type == "cuda" else ()
    before = [flag.allow_tf32 for flag in flags]
    try:
        for flag in flags:
            flag.allow_tf32 = False
        with torch.autocast(device.type, dtype=torch.bfloat16, enabled=precision == "bfloat16"):
            yield
    finally:
        for flag, allowed in zip(flags, before, strict=True):
            flag.allow_tf32 = allowed
