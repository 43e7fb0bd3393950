"""The name and the maker of this machine's processor. Standard library only."""

import platform
from functools import cache
from pathlib import Path

CPUINFO = Path("/proc/cpuinfo")


@cache
def processor() -> str:
    """The processor's name, with family and model: makers sell several models under one name."""
    facts = _facts()
    if "model name" not in facts:
        return platform.machine()
    kind = [f"{name} {facts[key]}" for name, key in (("family", "cpu family"), ("model", "model")) if key in facts]
    return f"{facts['model name']} ({', '.join(kind)})" if kind else facts["model name"]


@cache
def make() -> str:
    """The processor's maker, such as AuthenticAMD or GenuineIntel; the architecture where Linux does not tell.

    Makers are free in the last bits of the instructions that approximate reciprocals and inverse square roots (Intel
    64 and AMD64 manuals, RCPPS and RSQRTPS; each allows a relative error of 1.5 * 2^-12).
    """
    return _facts().get("vendor_id", platform.machine())


def _facts() -> dict[str, str]:
    """What Linux says of the first core."""
    first = CPUINFO.read_text(encoding="utf-8").partition("\n\n")[0] if CPUINFO.exists() else ""
    pairs = (line.split(":", 1) for line in first.splitlines() if ":" in line)
    return {name.strip(): value.strip() for name, value in pairs}
