"""Merge one real demonstration as many times as asked. Usage: python benchmarks/merge_many.py <folder> <count>"""

import shutil
import sys
from dataclasses import replace
from pathlib import Path

from lerobot_constructskill.contract import DEMO_SEED_START
from lerobot_constructskill.demos.merge import merge
from lerobot_constructskill.demos.settings import GenerateConfig
from lerobot_constructskill.demos.shards import Block, attempt


def main(folder: Path, count: int) -> None:
    config, shards = GenerateConfig("local/merged", episodes=count), folder / "shards"
    shards.mkdir(parents=True)
    first = attempt(config, DEMO_SEED_START, shards)
    attempts = [replace(first, seed=first.seed + number) for number in range(count)]
    for copy in attempts[1:]:
        shutil.copytree(shards / str(first.seed), shards / str(copy.seed))
    merge(config, [Block(config, shards, attempts)], folder / "set")


if __name__ == "__main__":
    main(Path(sys.argv[1]), int(sys.argv[2]))
