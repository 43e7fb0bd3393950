"""The names of LeRobot that this package uses though LeRobot does not export them; a release may move any of them.

`from lerobot_constructskill.lerobot_internals import write_video` imports LeRobot's module then and no sooner. All
else comes from LeRobot's packages by the names in their `__all__`: `from lerobot.datasets import LeRobotDataset`.
tests/test_lerobot_internals.py holds both rules, and says in a sentence each what a new LeRobot has changed.
"""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import cache
from importlib import import_module
from importlib.metadata import version
from pathlib import Path
from typing import Any, NotRequired, TypedDict

from lerobot_constructskill.errors import MachineError
from lerobot_constructskill.files import Json

NAMES = {
    # Vector environments that stand still after an episode's end, as LeRobot's own benchmarks make them.
    "_LazyAsyncVectorEnv": "lerobot.envs.utils",
    "FreezeAfterEpisodeEnd": "lerobot.envs.utils",
    "NEW_ROLLOUT_OPTION": "lerobot.envs.utils",
    # Statistics and files of data sets, read and written as LeRobot does it.
    "compute_episode_stats": "lerobot.datasets.compute_stats",
    "decode_video_frames": "lerobot.datasets.video_utils",
    "embed_images": "lerobot.datasets.dataset_writer",
    "load_episodes": "lerobot.datasets.dataset_metadata",
    "load_info": "lerobot.datasets.io_utils",
    "load_stats": "lerobot.datasets.io_utils",
    "RunningQuantileStats": "lerobot.datasets.compute_stats",
    "write_table_one_row_group_per_episode": "lerobot.datasets.io_utils",
    "write_video": "lerobot.utils.io_utils",
    # How a loader batches frames that hold annotations.
    "lerobot_collate_fn": "lerobot.utils.collate",
    # Where LeRobot keeps data sets, its own and those from the Hub.
    "HF_LEROBOT_HOME": "lerobot.utils.constants",
    "HF_LEROBOT_HUB_CACHE": "lerobot.utils.constants",
    # Of training and of plugins.
    "CosineAnnealingWithWarmupSchedulerConfig": "lerobot.optim.schedulers",
    "TrainPipelineConfig": "lerobot.configs.train",
    "register_third_party_plugins": "lerobot.utils.import_utils",
    # Of draccus, by which LeRobot reads its configurations: the parser of flags.
    "ArgumentParser": "draccus.argparsing",
}
"""Name to the module that holds it."""

LAST_CHECKPOINT = Path("checkpoints", "last", "pretrained_model")
"""Where `lerobot-train` leaves its newest checkpoint in its output folder."""

TRAIN_CONFIG = "train_config.json"
"""The file beside a checkpoint's weights that says what it was trained with."""


class _TrainingSet(TypedDict, total=False):
    repo_id: str
    root: str | None
    revision: str | None
    episodes: list[int] | None
    eval_split: float | None


class _Trained(TypedDict, total=False):
    seed: int | None
    dataset: _TrainingSet


class _Metrics(TypedDict):
    successes: list[bool]
    max_rewards: list[float]


class _Task(TypedDict):
    task_group: str
    task_id: int
    metrics: _Metrics


class _Evaluated(TypedDict):
    per_task: list[_Task]


class _Feature(TypedDict):
    dtype: str
    shape: list[int]
    info: NotRequired[dict[str, Any] | None]


class _Info(TypedDict):
    features: dict[str, _Feature]
    total_frames: NotRequired[int]
    video_path: NotRequired[str | None]


INFO = "meta/info.json"
"""The file that makes a folder a LeRobot data set."""

DATA_SET = Json("a LeRobot data set's description", _Info)
TRAINED = Json("what lerobot-train writes", _Trained)
EVALUATED = Json("what lerobot-eval writes", _Evaluated)
"""Readers of LeRobot's own files."""


def __getattr__(name: str) -> Any:
    if name not in NAMES:
        raise AttributeError(f"module '{__name__}' has no attribute '{name}'")
    owner = NAMES[name]
    try:
        return getattr(import_module(owner), name)
    except (AttributeError, ModuleNotFoundError) as error:
        if isinstance(error, ModuleNotFoundError) and not f"{owner}.".startswith(f"{error.name}."):
            raise  # a package that LeRobot itself lacks
        raise MachineError(
            f"LeRobot {version('lerobot')} has no {owner}.{name}, which this package needs: install a version that it "
            "was tried with (docs/lerobot.md)."
        ) from None


@cache
def load_plugins() -> None:
    """Import the installed LeRobot plugins, ours among them, once: they register policies and references."""
    __getattr__("register_third_party_plugins")()


@contextmanager
def patched(name: str, ours: Callable) -> Iterator[None]:
    """Within the block LeRobot calls `ours` in place of the function `name`, one of `NAMES`."""
    theirs, owner = __getattr__(name), import_module(NAMES[name])
    setattr(owner, name, ours)
    try:
        yield
    finally:
        setattr(owner, name, theirs)
