"""LeRobot's and our console commands as a user starts them, in forks of a process that has imported them (warm.py)."""

import atexit
import os
import subprocess
import sys
import tempfile
import time
from functools import cache
from importlib import metadata
from pathlib import Path

import warm

from lerobot_constructskill.artifacts.pools import be_killed_with_parent

BIN = Path(sys.executable).parent
QUICK = ["--num_workers=0", "--save_freq=2", "--log_freq=1"]
"""Flags of a `lerobot-train` that takes two steps or a few more."""

OFFLINE = {"HF_HUB_OFFLINE": "1", "CUDA_VISIBLE_DEVICES": "", "OMP_NUM_THREADS": "1", "OMP_WAIT_POLICY": "PASSIVE"}
"""On the CPU, in one thread and without the Hub."""


def call(command: str | Path, *flags: str, fails: bool = False, **surroundings: str) -> str:
    """Run a command, where nothing else is said as `OFFLINE` has it; return what it printed."""
    start = Path(command)
    if not start.is_absolute():
        warmed = warm_bin(**{name: value for name, value in surroundings.items() if name.startswith("HF_")})
        start = next(path for path in (warmed / command, BIN / command) if path.exists())
    run = subprocess.run([start, *flags], env=os.environ | OFFLINE | surroundings, capture_output=True, text=True)
    printed = run.stdout + run.stderr
    assert (run.returncode != 0) == fails, printed[-3000:]
    return printed


@cache
def warm_bin(**surroundings: str) -> Path:
    """The folder of commands that start warm, for PATH; the process behind them ends with this one.

    Each set of `surroundings`, variables that are read by imports, has a process of its own.
    """
    folder = tempfile.TemporaryDirectory(prefix="warm-")
    address = Path(folder.name) / "socket"
    server = subprocess.Popen(
        [sys.executable, warm.__file__, address],
        env=os.environ | OFFLINE | surroundings,
        preexec_fn=be_killed_with_parent,
    )
    atexit.register(folder.cleanup)
    atexit.register(server.kill)
    while not address.exists():
        assert server.poll() is None, "what is imported before the first command failed"
        time.sleep(0.05)
    scripts = metadata.entry_points(group="console_scripts")
    names = [script.name for script in scripts if script.name.startswith(("lerobot", "constructskill"))]
    warm.write_wrappers([*names, warm.CODE], Path(folder.name), address, BIN)
    return Path(folder.name)
