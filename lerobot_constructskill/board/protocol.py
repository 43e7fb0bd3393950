"""The protocol's numbers, which have their one home here: suites, starts, training seeds, limits."""

import re
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from hashlib import sha256
from typing import Annotated, Any

from lerobot_constructskill.bounds import Range, Seed, check
from lerobot_constructskill.contract import DEMO_SEED_STOP, SUITES, get_task
from lerobot_constructskill.errors import InputError
from lerobot_constructskill.perturbations import Perturbation

FIRST_START = 5000
"""Seed of the first evaluation start. Nothing was trained on it or on those that follow; docs/leaderboard.md says what
was chosen on them."""

STARTS = 50
"""Number of starts of every setting whose initial state is drawn."""

TRAINING_SEEDS = range(10)
"""Training seeds of a policy on the board. They are given, as ten chosen ones could be the best of a hundred."""

RANKED_FROM = len(TRAINING_SEEDS)
"""An entry with fewer training seeds has no rank. With fewer, intervals are so wide that leaving seeds out would raise
the rank: three that never place cannot be told from ten that always do."""

HORIZON = 300
"""Steps of an episode, 15 s, where one object is placed; the slowest expert needs 191 (`brick_to_bin_turned`). A plan
has as many as its task."""

FIXED = ("brick_to_bin",)
"""Tasks with one initial state: one episode, as all others would repeat it."""

PERTURBED_TASK, LEVEL = "brick_to_bin_shifted", 2
"""The suite `perturbed` is this task with each of `PERTURBED_AXES` at this level, beside the task as it is."""

PERTURBED_AXES = ("camera", "light", "texture", "size", "distractors", "pose", "sensor")
"""Those of `perturbations.AXES` that the suite has; with another one, all entries would lack a setting."""

CONTROL = "control"
"""Name of the setting without a perturbation, beside those with one."""

PHYSICS = "physx_cpu"
"""The only physics that a result is replayed on. PhysX on a GPU rounds otherwise and is never mixed with it."""

DRAND_START, DRAND_PERIOD = 1_692_803_367, 3
"""Seconds since 1970 of the first round of drand's chain quicknet, and seconds from one round to the next."""

DRAND = "https://api.drand.sh/52db9ba70e0cc0f6eaf7803dd07447a1f5477735fd3f661792ba94600c84e971/public/"
"""Before a round's number: where anyone can look up its randomness."""

RERUN_STARTS = 20
"""Starts of every setting that are run anew for the level re-run."""

RERUN_ALPHA = 0.01
"""A re-run confirms a submission unless fresh starts went worse with a smaller p-value than this. So does training
again on another kind of machine, where its seeds are compared."""

CLAIMED, REPLAYED, RERUN, RETRAINED = LEVELS = ("claimed", "replayed", "re-run", "retrained")
"""What is known of an entry: its author claims the outcomes; its actions have these outcomes; its checkpoints do as
well on starts that nobody could know when it was submitted; its recipe, trained again, makes such policies."""

STANDARD, CUSTOM = CLASSES = ("standard", "custom")
"""A submission with exactly the settings of its suite and training seeds of the protocol, and any other."""

FIRST_FRESH = DEMO_SEED_STOP
"""Starts of re-runs lie from here on, above those of demonstrations and of every protocol."""


@dataclass(frozen=True)
class BoardSetting:
    """Where a policy is evaluated, and from which starts.

    Args:
        task: a name in `contract.TASKS`.
        episodes: number of starts.
        episode_length: steps after which an episode ends without success.
        first_start: seed of the first start; the others have the seeds that follow.
        perturb, perturb_seed: as `--env.perturb` and `--env.perturb_seed`.

    Raises:
        InputError: there is no such task or perturbation, or a number is out of its bounds.
    """

    task: str
    episodes: Annotated[int, Range(1, 10_000)] = STARTS
    episode_length: Annotated[int, Range(1, 10_000, unit="steps")] = HORIZON
    first_start: Seed = FIRST_START
    perturb: str = ""
    perturb_seed: Seed = 0

    def __post_init__(self):
        check(self)
        Perturbation(self.perturb, self.perturb_seed).check(get_task(self.task))
        last = self.first_start + self.episodes - 1
        if last >= 2**31:
            raise InputError(f"The last start must be at most {2**31 - 1}, not {last}.")

    @property
    def starts(self) -> range:
        return range(self.first_start, self.first_start + self.episodes)

    @property
    def perturbation(self) -> str:
        """Label of the perturbation, empty without one; two spellings of one perturbation have one label."""
        return Perturbation(self.perturb, self.perturb_seed).label

    @property
    def environment(self) -> dict[str, Any]:
        """Arguments of `ConstructSkillEnv`, those of `recording.ENVIRONMENT`."""
        names = ("task", "episode_length", "perturb", "perturb_seed")
        return {name: getattr(self, name) for name in names}

    @property
    def compared(self) -> tuple:
        """Equal for settings whose results can be compared: they are the same but for their names."""
        return environment_key(**self.environment), self.starts


def environment_key(
    task: str, episode_length: int | None = None, perturb: str = "", perturb_seed: int = 0, action: str = ""
) -> tuple[str, int, str]:
    """Task, length and perturbation of an environment with these arguments: what beside a start decides an episode.

    The form of the `action` does not: a policy is free to act in either.
    """
    return task, episode_length or get_task(task).horizon, Perturbation(perturb, perturb_seed).label


@dataclass(frozen=True)
class Suite:
    """A page of the board.

    Args:
        title: heading of the page.
        settings: name to setting; each is a column of the table.
    """

    title: str
    settings: dict[str, BoardSetting]


def _settings(tasks: tuple[str, ...]) -> dict[str, BoardSetting]:
    return {task: BoardSetting(task, 1 if task in FIXED else STARTS, steps_of(task)) for task in tasks}


def steps_of(task: str) -> int:
    """Steps of an episode, of a task of one object or of a plan."""
    found = get_task(task)
    return found.horizon if found.plan else HORIZON


_PERTURBED = {CONTROL: BoardSetting(PERTURBED_TASK)} | {
    axis: BoardSetting(PERTURBED_TASK, perturb=f"{axis}={LEVEL}") for axis in PERTURBED_AXES
}

BOARD_SUITES = {
    "bins": Suite("Bins: put it in", _settings(SUITES["bins"])),
    "ladder": Suite("Ladder: less and less clearance", _settings(SUITES["ladder"])),
    "joints": Suite("Joints: set it flush", _settings(SUITES["joints"])),
    "orders": Suite("Orders: do what is said", _settings(SUITES["orders"])),
    "wall": Suite("Wall: lay one after another", _settings(SUITES["wall"])),
    "perturbed": Suite("Perturbed: one thing changed at a time", _PERTURBED),
}
"""Every suite of the board, by name."""


def class_of(suite: str, settings: Mapping[str, BoardSetting], training_seeds: Iterable[int]) -> str:
    """`STANDARD` with a suite's settings and the protocol's seeds, else `CUSTOM`. It is compared, not declared."""
    is_standard = settings == BOARD_SUITES[suite].settings and set(TRAINING_SEEDS) >= set(training_seeds)
    return STANDARD if is_standard else CUSTOM


@dataclass(frozen=True)
class PublicValue:
    """A random number that nobody could know before it was published: a round of drand's chain quicknet.

    Args:
        round: its number, which says when it was published.
        randomness: 64 hexadecimal digits.
    """

    round: int
    randomness: str

    @classmethod
    def of(cls, text: str) -> "PublicValue":
        """The value of `ROUND:RANDOMNESS`.

        Raises:
            InputError: it is not one, or its round is still to come.
        """
        found = re.fullmatch(r"([1-9][0-9]{0,8}):([0-9a-f]{64})", text.strip().lower())
        if not found:
            raise InputError(
                f"The public value must be a round of drand and its randomness, ROUND:64 hexadecimal digits, as "
                f"{DRAND}latest says, not {text!a:.80}."
            )
        value = cls(int(found[1]), found[2])
        if value.published > datetime.now(UTC):
            raise InputError(f"Round {value.round} of drand is still to come.")
        return value

    def __str__(self) -> str:
        return f"{self.round}:{self.randomness}"

    @property
    def published(self) -> datetime:
        return datetime.fromtimestamp(DRAND_START + (self.round - 1) * DRAND_PERIOD, UTC)

    @property
    def address(self) -> str:
        """Where anyone can look it up."""
        return f"{DRAND}{self.round}"


def fresh_start(submission: str, value: PublicValue) -> int:
    """The first start of a re-run: known to nobody before `value` is.

    Args:
        submission: hash of the submission.
        value: one that was published after it.
    """
    drawn = int.from_bytes(sha256(f"{submission}/{value}".encode()).digest())
    return FIRST_FRESH + drawn % (2**30 - 10_000)


def fresh_settings(settings: Mapping[str, BoardSetting], first_start: int) -> dict[str, BoardSetting]:
    """The settings of a re-run: as those of a submission, from `RERUN_STARTS` fresh starts.

    Tasks with one initial state are left out: a fresh start of theirs is the one that is known.
    """
    return {
        name: replace(one, episodes=min(one.episodes, RERUN_STARTS), first_start=first_start)
        for name, one in settings.items()
        if one.task not in FIXED
    }
