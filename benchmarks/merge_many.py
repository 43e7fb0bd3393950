"""Merge one real demonstration as many times as asked. Usage: python benchmarks/merge_many.py <folder> <count>"""

import shutil
import sys
from dataclasses import replace
from pathlib import Path

from lerobot_constructskill.contract import DEMO_SEED_START
from lerobot_constructskill.demos.merge import merge
from lerobot_constructskill.demos.settings import GenerateConfig
from lerobot_constructskill.demos.shards import Attempt, attempt


def copies(shards: Path, count: int) -> tuple[GenerateConfig, list[Attempt]]:
    """Make one demonstration and put as many shards of it into a folder; return what `merge` takes beside them."""
    config = GenerateConfig("local/merged", episodes=count)
    shards.mkdir(parents=True)
    first = attempt(config, DEMO_SEED_START, shards)
    attempts = [replace(first, seed=first.seed + number) for number in range(count)]
    for copy in attempts[1:]:
        shutil.copytree(shards / str(first.seed), shards / str(copy.seed))
    return config, attempts


def main(folder: Path, count: int) -> None:
    shards = folder / "shards"
    merge(*copies(shards, count), shards, folder / "set")


if __name__ == "__main__":
    main(Path(sys.argv[1]), int(sys.argv[2]))
