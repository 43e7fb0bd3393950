"""`constructskill-dagger`: a learner drives, the expert labels, and the policy is trained on both."""

from pathlib import Path

from lerobot_constructskill.dagger.settings import DaggerConfig
from lerobot_constructskill.errors import plural
from lerobot_constructskill.scripts.console import command, say


@command("constructskill-dagger smoke --rounds=2", presets="dagger")
def dagger(config: DaggerConfig) -> str:
    """Run DAgger, print a line for each policy, and return where the data set and the checkpoint are.

    Raises:
        FileExistsError: the root exists already, or another process is writing it.
        ValueError: a field cannot be used.
        OSError: the disk is full, this machine cannot render, or a process died.
    """
    from lerobot_constructskill.artifacts.store import Store
    from lerobot_constructskill.dagger.run import run_dagger

    root = Path(config.root) if config.root else Path("outputs/dagger") / config.repo_id.split("/")[1]
    lines = run_dagger(config, Store(config.store.absolute()), root.absolute(), say)
    size = f"{plural(config.rounds, 'round')}, {plural(lines[-1].frames, 'frame')}"
    return f"{size}: {root}/dataset, {root}/checkpoint"


if __name__ == "__main__":
    dagger.main()
