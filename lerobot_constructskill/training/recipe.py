"""How long and on what part of the demonstrations a policy is trained."""

from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated, TypedDict

from lerobot_constructskill.bounds import BatchSize, Count, Range, check
from lerobot_constructskill.contract import HELD_OUT_EVERY, TASK_NAME, held_out
from lerobot_constructskill.files import Json

if TYPE_CHECKING:
    from lerobot.datasets import LeRobotDataset


@dataclass(frozen=True)
class Training:
    """How a policy is trained on demonstrations. Learning rate and weight decay are the policy's.

    Args:
        epochs: times that it sees each of the demonstrations that are not held out.
        batch_size: frames per step.
        holdout: every holdout-th demonstration is held out.

    Raises:
        ValueError: a number out of its range.
    """

    epochs: Count = 150
    batch_size: BatchSize = 256
    holdout: Annotated[int, Range(2, 1_000_000)] = HELD_OUT_EVERY

    def __post_init__(self):
        check(self, "training.")


def held_out_of(dataset: "LeRobotDataset", every: int = HELD_OUT_EVERY) -> list[int]:
    """The held-out episodes of a data set or of its features; in a set of several tasks they are counted by task."""
    episodes = dataset.meta.episodes
    return held_out(episodes[TASK_NAME] if TASK_NAME in episodes.column_names else dataset.num_episodes, every)


class _Holdout(TypedDict):
    holdout: int


class _Facts(TypedDict):
    seed: int
    training: _Holdout
    made_of: dict[str, str]


FACTS = "training.json"
"""File in each checkpoint of a study or of DAgger."""

SAID = Json("what a study says of a checkpoint's training", _Facts)
"""Its training seed, its recipe, and what rows say that it stands on."""
