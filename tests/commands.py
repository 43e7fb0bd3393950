"""LeRobot's and our console commands as a user starts them: each in a process of its own."""

import os
import subprocess
import sys
from pathlib import Path

BIN = Path(sys.executable).parent
QUICK = ["--num_workers=0", "--save_freq=2", "--log_freq=1"]
"""Flags of a `lerobot-train` that takes two steps or a few more."""


def call(command: str, *flags: str, fails: bool = False, **surroundings: str) -> str:
    """Run a command on the CPU and, where nothing else is said, without the Hub; return what it printed."""
    usual = {"HF_HUB_OFFLINE": "1", "CUDA_VISIBLE_DEVICES": "", "OMP_NUM_THREADS": "1"}
    run = subprocess.run(
        [BIN / command, *flags], env=os.environ | usual | surroundings, capture_output=True, text=True
    )
    printed = run.stdout + run.stderr
    assert (run.returncode != 0) == fails, printed[-3000:]
    return printed
