"""A few episodes of each setting of a board's entry, executed in this one process: for a CPU that is emulated.

Usage: qemu-x86_64 -cpu Nehalem .venv/bin/python examples/replay_emulated.py board/entries/bins_expert 2

(`constructskill-verify` replays in processes of its own, which QEMU would start on the real CPU.)
"""

import sys
from pathlib import Path

import torch

from lerobot_constructskill.board.replay import difference, open_simulator
from lerobot_constructskill.board.submission import read_submission


def main(root: Path, episodes: int) -> None:
    torch.set_num_threads(1)
    print(f"torch finds {torch.backends.cpu.get_cpu_capability()}")
    submission = read_submission(root)
    for name, setting in submission.declaration.settings.items():
        env = open_simulator(setting.environment)
        for claim in [claim for claim in submission.claims if claim.setting == name][:episodes]:
            print(difference(env, claim) or f"{claim.label}: as claimed, {claim.steps} steps")
        env.close()


if __name__ == "__main__":
    main(Path(sys.argv[1]), int(sys.argv[2]))
