"""This machine's processor, for whatever says where it was made. Standard library only."""

import platform
from functools import cache
from pathlib import Path

CPUINFO = Path("/proc/cpuinfo")


@cache
def processor() -> str:
    """Its name, with family and model, by which makers tell apart what they sell under one name."""
    lines = CPUINFO.read_text().splitlines() if CPUINFO.exists() else []
    facts = dict(reversed([[part.strip() for part in line.split(":", 1)] for line in lines if ":" in line]))
    if "model name" not in facts:
        return platform.machine()
    kind = [f"{name} {facts[key]}" for name, key in (("family", "cpu family"), ("model", "model")) if key in facts]
    return f"{facts['model name']} ({', '.join(kind)})" if kind else facts["model name"]
