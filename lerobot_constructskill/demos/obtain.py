"""Demonstrations from a store, where they are made if they are not there."""

from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from lerobot_constructskill.artifacts.store import Artifact, Store
from lerobot_constructskill.demos.recorder import SHARDS, check_disk, write
from lerobot_constructskill.demos.settings import GenerateConfig, code_facts, generator_facts
from lerobot_constructskill.envs.gym_env import resolve_rendering

if TYPE_CHECKING:
    from lerobot.datasets import LeRobotDataset


def artifact(config: GenerateConfig) -> Artifact:
    """The data set of `config`, whatever it is called and wherever it lies; what renders it is part of it."""
    facts = generator_facts(config)
    for name in ("repo_id", "max_failures"):
        del facts[name]
    light_robot, backend = resolve_rendering(config.light_robot)
    drawn = {"light_robot": light_robot, "render_backend": backend}
    return Artifact("demonstrations", facts | code_facts(config) | drawn)


def obtain_demonstrations(config: GenerateConfig, store: Store) -> "LeRobotDataset":
    """Return the data set of `config`. Raises as `recorder.record` does."""
    from lerobot.datasets import LeRobotDataset

    made = artifact(config)
    repo_id = f"local/{made.digest}"

    def make(folder: Path) -> None:
        check_disk(config, store.folder(made))
        write(replace(config, repo_id=repo_id), folder)

    return LeRobotDataset(repo_id, root=store.obtain(made, make, keep=SHARDS))
