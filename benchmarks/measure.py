"""What the benchmarks share: a stopwatch, LeRobot's scripts as subprocesses, and one JSON line per measurement."""

import json
import os
import subprocess
import sys
import time
from pathlib import Path
from typing import NamedTuple

BIN = Path(sys.executable).parent
OUT = Path(os.environ.get("BENCH_OUT", "outputs/bench"))
LOG = OUT / "last_command.log"


class Timer:
    """Adds up the seconds spent in its `with` blocks."""

    seconds = 0.0
    clock = staticmethod(time.perf_counter)

    def __enter__(self):
        self._start = self.clock()
        return self

    def __exit__(self, *_):
        self.seconds += self.clock() - self._start


class CpuTimer(Timer):
    """Adds up the seconds that all threads of this process together computed in its `with` blocks."""

    clock = staticmethod(time.process_time)


def report(
    what: str,
    ours: float,
    baseline_name: str,
    baseline: float,
    target: float | None = None,
    note: str = "",
    less_is_better: bool = False,
) -> None:
    """Print a line of the table for `run.py` to collect; its ratio is how many times better ours is."""
    measured = {"what": what, "ours": ours, "baseline_name": baseline_name, "baseline": baseline}
    ratio = baseline / ours if less_is_better else ours / baseline
    print(json.dumps(measured | {"ratio": ratio, "target": target, "note": note}), flush=True)


class Ran(NamedTuple):
    """What a command took, from start to end."""

    seconds: float
    peak_mb: float


def run(*command: str) -> Ran:
    """Run a command of this environment without the Hub; what it prints goes to `LOG`.

    Raises:
        RuntimeError: it failed; the message ends with what it printed last.
    """
    with Timer() as timer, LOG.open("w") as file:
        surroundings = os.environ | {"HF_HUB_OFFLINE": "1"}
        process = subprocess.Popen([BIN / command[0], *command[1:]], stdout=file, stderr=file, env=surroundings)
        _, status, usage = os.wait4(process.pid, 0)
    if status:
        raise RuntimeError(f"{command[0]} failed: {LOG.read_text()[-2000:]}")
    return Ran(timer.seconds, usage.ru_maxrss / 1024)
