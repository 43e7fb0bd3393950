"""Demonstrations into a LeRobotDataset: seeds in order, failures discarded and counted, all or nothing on disk.

Every attempt becomes a shard, as many at a time as there are workers; a run that was interrupted continues with the
shards that it finished.
"""

import logging
from concurrent.futures import FIRST_COMPLETED, Future, wait
from itertools import count
from pathlib import Path

from lerobot_constructskill.artifacts.code import check_unedited
from lerobot_constructskill.artifacts.disk import check_free
from lerobot_constructskill.artifacts.folders import staged
from lerobot_constructskill.artifacts.pools import Submit, open_pool
from lerobot_constructskill.contract import DEMO_SEED_START, DEMO_SEED_STOP
from lerobot_constructskill.demos.merge import merge
from lerobot_constructskill.demos.settings import GenerateConfig, frame_versions, frames_digest
from lerobot_constructskill.demos.shards import ATTEMPT, OUTCOME, Attempt, Block, attempt, whole
from lerobot_constructskill.demos.video import VIDEOS
from lerobot_constructskill.errors import InputError, plural
from lerobot_constructskill.progress import Progress

logger = logging.getLogger(__name__)

SHARDS = "shards"


def record(config: GenerateConfig) -> tuple[Path, list[Attempt]]:
    """Write the data set of `config`; it is the same however many workers there are and however often it was killed.

    What a killed or failed run finished stays in `<root>.partial` until the data set is whole. Shards of other
    settings are not looked at.

    Returns:
        The data set's root, and all attempts, task by task in the order of their seeds, the failed and discarded ones
        among them.

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
    shards = folder.with_name(SHARDS)
    blocks = [Block(part, shards / frames_digest(part)) for part in config.parts]
    before = frame_versions(config)
    with open_pool(config.executor, config.workers) as submit:
        _run_attempts(config, blocks, submit)
        check_unedited(before, frame_versions(config))
        with Progress(desc="merging", bar_format="{desc} {elapsed}", leave=False):
            # By a worker, which has imported LeRobot: that would take this process 5 to 16 s.
            submit(merge, config, blocks, folder).result()
    return [attempt for block in blocks for attempt in block.attempts]


def _run_attempts(config: GenerateConfig, blocks: list[Block], submit: Submit) -> None:
    """Run attempts, or find their shards, until enough have succeeded in every block.

    No more attempts of a block run at once than it still needs, so which seeds are taken does not depend on the
    workers.
    """
    before = [{one.seed: one for one in whole(block.shards, OUTCOME, ATTEMPT.read)} for block in blocks]
    seeds = [count(config.seed_start) for _ in blocks]
    running: dict[Future, int] = {}  # to the number of the block
    found = sum(min(config.episodes, sum(one.success for one in known.values())) for known in before)
    total = config.episodes * len(blocks)
    # Smoothed, so that the start of the simulators, part of the first demonstration's time, counts less and less.
    bar = Progress(total=total, initial=found, desc="demonstrations", unit="demo", smoothing=0.1)
    with bar:
        while True:
            bar.set_postfix(discarded=sum(len(block.discarded) for block in blocks), refresh=False)
            bar.update(max(0, sum(len(block.demonstrations) for block in blocks) - bar.n))
            number = _next_block(config, blocks, [*running.values()])
            if number is not None and len(running) < config.workers:
                block, seed = blocks[number], next(seeds[number])
                if seed in before[number]:
                    block.attempts.append(before[number][seed])
                else:
                    running[submit(attempt, block.config, seed, block.shards)] = number
            elif running:
                for future in wait(running, return_when=FIRST_COMPLETED).done:
                    blocks[running.pop(future)].attempts.append(future.result())
            else:
                break
    for block in blocks:
        block.attempts.sort(key=lambda outcome: outcome.seed)


def _next_block(config: GenerateConfig, blocks: list[Block], running: list[int]) -> int | None:
    """The number of the first block that needs more attempts than are `running` of it; None where none does.

    Raises:
        InputError: more attempts of a block failed than `max_failures` allows.
    """
    for number, block in enumerate(blocks):
        if (failures := len(block.discarded)) > config.max_failures * config.episodes:
            of_task = f" at {block.config.task}" if len(blocks) > 1 else ""
            raise InputError(
                f"{plural(failures, 'attempt')}{of_task} failed, more than max_failures={config.max_failures} allows "
                f"for {plural(config.episodes, 'demonstration')}: check the expert's and the noise's values."
            )
        if running.count(number) < config.episodes - len(block.demonstrations):
            return number
    return None


def check_disk(config: GenerateConfig, root: Path) -> None:
    """Refuse a disk that could not hold the longest episodes twice, as shards and merged."""
    episodes = config.episodes * len(config.rows)
    images = episodes * config.max_steps * len(config.seen)
    needed = 2 * VIDEOS[config.video].bytes_per_image * images
    check_free(
        root,
        needed,
        f" and {plural(episodes, 'episode')} of up to {plural(config.max_steps, 'step')} can take up to "
        f"{needed / 1e6:,.0f} MB: make room, name another root, or ask for fewer.",
    )
