"""LeRobot's and our console commands as a user starts them, in forks of a process that has imported them (warm.py)."""

import atexit
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from contextlib import redirect_stderr, redirect_stdout
from functools import cache
from importlib import metadata
from io import StringIO
from pathlib import Path

import pytest
import warm

from lerobot_constructskill.artifacts.pools import be_killed_with_parent

BIN = Path(sys.executable).parent
QUICK = ["--num_workers=0", "--save_freq=2", "--log_freq=1"]
"""Flags of a `lerobot-train` that takes two steps or a few more."""

OFFLINE = {"HF_HUB_OFFLINE": "1", "CUDA_VISIBLE_DEVICES": "", "OMP_NUM_THREADS": "1", "OMP_WAIT_POLICY": "PASSIVE"}
"""On the CPU, in one thread and without the Hub."""


def call(command: str | Path, *flags: str, fails: bool = False, **surroundings: str) -> str:
    """Run a command, where nothing else is said as `OFFLINE` has it; return what it printed."""
    start = BIN / command  # an absolute path stays it
    if command in (*names(), warm.CODE):
        start = warm_bin(**{name: value for name, value in surroundings.items() if name.startswith("HF_")}) / command
    run = subprocess.run([start, *flags], env=os.environ | OFFLINE | surroundings, capture_output=True, text=True)
    printed = run.stdout + run.stderr
    assert (run.returncode != 0) == fails, printed[-3000:]
    return printed


@cache
def names() -> list[str]:
    """LeRobot's and our console commands."""
    scripts = metadata.entry_points(group="console_scripts")
    return [script.name for script in scripts if script.name.startswith(("lerobot", "constructskill"))]


@cache
def warm_bin(**surroundings: str) -> Path:
    """The folder of commands that start warm, for PATH; the process behind them ends with this one.

    Each set of `surroundings`, variables that are read by imports, has a process of its own.
    """
    folder = tempfile.TemporaryDirectory(prefix="warm-")
    address = Path(folder.name) / "socket"
    server = subprocess.Popen(
        [sys.executable, warm.__file__, address],
        env=os.environ | OFFLINE | surroundings | {"PYTHONPATH": ""},  # each command brings its own
        preexec_fn=be_killed_with_parent,
    )
    atexit.register(folder.cleanup)
    atexit.register(server.kill)
    while not address.exists():
        assert server.poll() is None, "what is imported before the first command failed"
        time.sleep(0.05)
    warm.write_wrappers([*names(), warm.CODE], Path(folder.name), address, BIN)
    return Path(folder.name)


def call_inside(main: Callable[[], object], *argv: str) -> tuple[int, str, str]:
    """Call a command's function in this process; return its exit status, what it printed, and its errors."""
    status = 0
    with (
        pytest.MonkeyPatch.context() as patch,
        redirect_stdout(StringIO()) as printed,
        redirect_stderr(StringIO()) as said,
    ):
        patch.setattr(sys, "argv", list(argv))
        patch.setenv("OMP_WAIT_POLICY", "PASSIVE")  # which a command sets
        try:
            main()
        except SystemExit as exit:
            status = exit.code or 0
    return status, printed.getvalue(), said.getvalue()
