"""What a killed process leaves behind: nothing, within seconds, whatever its helpers were busy with."""

import subprocess
import sys
import time
from pathlib import Path

import pytest

SIMULATE = """
import time
from lerobot_constructskill.rollout.simulators import simulators
if __name__ == "__main__":
    with simulators([{"task": "block_to_bin", "render_backend": "none"}] * 2, 2) as worlds:
        print("started", flush=True)
        worlds.reset({0: 1, 1: 2})
        time.sleep(300)
"""
SECONDS = 5


def children(process: int) -> set[int]:
    """Processes below one, at any depth."""
    stats = [path.read_text().rsplit(")", 1) for path in Path("/proc").glob("[0-9]*/stat") if path.exists()]
    parents = {int(head.split(" ")[0]): int(tail.split()[1]) for head, tail in stats}
    found = {process}
    while below := {child for child, parent in parents.items() if parent in found} - found:
        found |= below
    return found - {process}


def alive(process: int) -> bool:
    try:
        return Path(f"/proc/{process}/stat").read_text().rsplit(")", 1)[1].split()[0] != "Z"
    except OSError:
        return False


@pytest.mark.sim
@pytest.mark.slow
@pytest.mark.skipif(sys.platform != "linux", reason="elsewhere a fork server finishes its imports first")
@pytest.mark.parametrize("moment_s", [0.5, 5, 15], ids=["it imports", "they import", "they simulate"])
def test_nothing_outlives_a_killed_parent(moment_s: float, tmp_path: Path) -> None:
    (tmp_path / "simulate.py").write_text(SIMULATE)
    parent = subprocess.Popen([sys.executable, tmp_path / "simulate.py"], stdout=subprocess.PIPE)
    parent.stdout.readline()
    time.sleep(moment_s)
    left = children(parent.pid)
    assert left
    parent.kill()
    parent.wait()
    parent.stdout.close()
    deadline = time.monotonic() + SECONDS
    while (left := {process for process in left if alive(process)}) and time.monotonic() < deadline:
        time.sleep(0.1)
    assert not left
