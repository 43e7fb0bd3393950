"""Demonstrations into a LeRobotDataset: seeds in order, failures discarded and counted, all or nothing on disk.

Every attempt becomes a shard, as many at a time as there are workers; a run that was interrupted continues with the
shards that it finished.
"""

import logging
import shutil
from concurrent.futures import FIRST_COMPLETED, wait
from itertools import count
from pathlib import Path

from lerobot_constructskill.artifacts.code import check_unedited
from lerobot_constructskill.artifacts.disk import disk_of
from lerobot_constructskill.artifacts.folders import staged
from lerobot_constructskill.artifacts.pools import open_pool
from lerobot_constructskill.contract import DEMO_SEED_START, DEMO_SEED_STOP
from lerobot_constructskill.demos.merge import merge
from lerobot_constructskill.demos.settings import GenerateConfig, frame_versions, frames_digest
from lerobot_constructskill.demos.shards import ATTEMPT, OUTCOME, Attempt, attempt, whole
from lerobot_constructskill.demos.video import VIDEOS
from lerobot_constructskill.errors import InputError, MachineError, plural
from lerobot_constructskill.progress import Progress, quiet

logger = logging.getLogger(__name__)

SHARDS = "shards"


def record(config: GenerateConfig) -> tuple[Path, list[Attempt]]:
    """Write the data set of `config`; it is the same however many workers there are and however often it was killed.

    What a killed or failed run finished stays in `<root>.partial` until the data set is whole. Shards of other
    settings are not looked at.

    Returns:
        The data set's root, and all attempts in the order of their seeds, the failed and discarded ones among them.

    Raises:
        FileExistsError: the root exists already, or another process is writing it.
        ValueError: more attempts failed than `max_failures` allows.
        OSError: the disk may not hold it, this machine cannot render, or a worker process died.
    """
    from lerobot_constructskill.lerobot_internals import HF_LEROBOT_HOME

    root = Path(config.root) if config.root else HF_LEROBOT_HOME / config.repo_id
    check_disk(config, root)
    with staged(root, keep=SHARDS) as folder:
        attempts = write(config, folder)
    return root, attempts


def write(config: GenerateConfig, folder: Path) -> list[Attempt]:
    """Write the data set to a path that `staged` gave, by way of shards beside it. Raises as `record` does."""
    starts = config.starts
    if starts.start < DEMO_SEED_START or starts.stop > DEMO_SEED_STOP:
        logger.warning(
            "Seeds %d to %d are not among those of demonstrations, %d to %d: a policy that is evaluated from one of "
            "them has seen its start.",
            *(starts.start, starts.stop - 1, DEMO_SEED_START, DEMO_SEED_STOP - 1),
        )
    shards = folder.with_name(SHARDS) / frames_digest(config)
    before = frame_versions(config.task)
    attempts = _run_attempts(config, shards)
    check_unedited(before, frame_versions(config.task))
    with Progress(desc="merging", bar_format="{desc} {elapsed}", leave=False), quiet():
        merge(config, attempts, shards, folder)
    return attempts


def _run_attempts(config: GenerateConfig, shards: Path) -> list[Attempt]:
    """Run attempts, or find their shards, until enough have succeeded; return them in the order of their seeds.

    No more attempts run at once than are still needed, so which seeds are taken does not depend on the workers.
    """
    before = {outcome.seed: outcome for outcome in whole(shards, OUTCOME, ATTEMPT.read)}
    attempts, running = [], set()
    seeds = count(config.seed_start)
    found = min(config.episodes, sum(outcome.success for outcome in before.values()))
    # Smoothed, so that the start of the simulators, part of the first demonstration's time, counts less and less.
    bar = Progress(total=config.episodes, initial=found, desc="demonstrations", unit="demo", smoothing=0.1)
    with bar, open_pool(config.executor, config.workers) as submit:
        while True:
            successes = sum(outcome.success for outcome in attempts)
            bar.set_postfix(discarded=len(attempts) - successes, refresh=False)
            bar.update(max(0, successes - bar.n))
            if (failures := len(attempts) - successes) > config.max_failures * config.episodes:
                raise InputError(
                    f"{plural(failures, 'attempt')} failed, more than max_failures={config.max_failures} allows for "
                    f"{plural(config.episodes, 'demonstration')}: check the expert's and the noise's values."
                )
            if len(running) < min(config.episodes - successes, config.workers):
                seed = next(seeds)
                if seed in before:
                    attempts.append(before[seed])
                else:
                    running.add(submit(attempt, config, seed, shards))
            elif running:
                done, running = wait(running, return_when=FIRST_COMPLETED)
                attempts += [future.result() for future in done]
            else:
                return sorted(attempts, key=lambda outcome: outcome.seed)


def check_disk(config: GenerateConfig, root: Path) -> None:
    """Refuse a disk that could not hold the longest episodes twice, as shards and merged."""
    images = config.episodes * config.max_steps * len(config.seen)
    needed = 2 * VIDEOS[config.video].bytes_per_image * images
    disk = disk_of(root.parent)
    free = shutil.disk_usage(disk).free
    if free < needed:
        raise MachineError(
            f"{disk} has {free / 1e6:,.0f} MB free and {plural(config.episodes, 'episode')} of up to "
            f"{plural(config.max_steps, 'step')} can take up to {needed / 1e6:,.0f} MB: make room, name another root, "
            "or ask for fewer."
        )
