"""The protocol's numbers, which have their one home here: suites, starts, episodes, training seeds, limits."""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from hashlib import sha256
from typing import Annotated

from lerobot_constructskill.bounds import Range, Seed, check
from lerobot_constructskill.contract import DEMO_SEED_STOP, get_task
from lerobot_constructskill.contract import SUITES as TASKS_OF
from lerobot_constructskill.errors import InputError
from lerobot_constructskill.perturbations import AXES, Perturbation

FIRST_START = 5000
"""Seed of the first evaluation start. None of them was trained on; docs/leaderboard.md says what was chosen there."""

EPISODES = 50
"""Starts of every setting whose initial state is drawn."""

TRAINING_SEEDS = range(10)
"""Of a policy that is trained for the board. Nobody chooses them: ten others could be the best of a hundred."""

RANKED_FROM = len(TRAINING_SEEDS)
"""Training seeds below which an entry has no rank. With fewer, intervals are so wide that leaving seeds out
would raise it: three that never place cannot be told from ten that always do."""

HORIZON = 300
"""Steps of an episode, 15 s. The slowest expert needs 191 (`brick_to_bin_turned`), the others about 100 to 175."""

FIXED = ("brick_to_bin",)
"""Tasks with one initial state: one episode, for all others would repeat it."""

PERTURBED_TASK, LEVEL = "brick_to_bin_shifted", 2
"""The suite `perturbed` is this task with each axis at this level, beside the task as it is."""

CONTROL = "control"
"""Name of the setting without a perturbation, beside those with one."""

PHYSICS = "physx_cpu"
"""The only physics that a result is replayed on. PhysX on a GPU rounds otherwise and is never mixed with it."""

RERUN_EPISODES = 20
"""Starts of every setting that are run anew for the level re-run."""

RERUN_ALPHA = 0.01
"""A re-run confirms a submission unless fresh starts went worse with a smaller p-value than this."""

CLAIMED, REPLAYED, RERUN = LEVELS = ("claimed", "replayed", "re-run")
"""What is known of an entry: what its author says; that its actions have the outcomes that it says; that its
checkpoint does as well on starts that nobody could know when it was submitted."""

STANDARD, CUSTOM = CLASSES = ("standard", "custom")
"""A submission with exactly the settings of its suite and training seeds of the protocol, and any other."""

FIRST_FRESH = DEMO_SEED_STOP
"""Starts of re-runs lie from here on: above those of demonstrations and of every protocol."""


@dataclass(frozen=True)
class Setting:
    """Where a policy is evaluated, and from which starts.

    Args:
        task: a name in `contract.TASKS`.
        episodes: so many starts.
        episode_length: steps after which an episode ends without success.
        first_start: seed of the first start; those that follow have the seeds that follow.
        perturb, perturb_seed: as `--env.perturb` and `--env.perturb_seed`.

    Raises:
        InputError: there is no such task or perturbation, or a number is out of its bounds.
    """

    task: str
    episodes: Annotated[int, Range(1, 10_000)] = EPISODES
    episode_length: Annotated[int, Range(1, 10_000, unit="steps")] = HORIZON
    first_start: Seed = FIRST_START
    perturb: str = ""
    perturb_seed: Seed = 0

    def __post_init__(self):
        check(self)
        Perturbation(self.perturb, self.perturb_seed).check(get_task(self.task))
        if self.first_start + self.episodes > 2**31:
            raise InputError(
                f"The last start must be at most {2**31 - 1}, not {self.first_start + self.episodes - 1}."
            )

    @property
    def starts(self) -> range:
        return range(self.first_start, self.first_start + self.episodes)

    @property
    def perturbation(self) -> str:
        """Its label, empty where there is none; two spellings of one perturbation have one label."""
        return Perturbation(self.perturb, self.perturb_seed).label

    @property
    def pictures(self) -> tuple[float, ...]:
        """What the perturbation changes in all pictures and in nothing else."""
        return Perturbation(self.perturb, self.perturb_seed).pictures

    @property
    def where(self) -> tuple[str, int, str]:
        """What its episodes have in common, as `where` says it."""
        return where(self.task, self.episode_length, self.perturb, self.perturb_seed)

    @property
    def compared(self) -> tuple:
        """Equal for settings whose results can be compared: they are the same but for their names."""
        return *self.where, self.starts


def where(
    task: str, episode_length: int | None = None, perturb: str = "", perturb_seed: int = 0
) -> tuple[str, int, str]:
    """Task, length and perturbation of an environment with these arguments: what beside a start decides an episode."""
    return task, episode_length or get_task(task).horizon, Perturbation(perturb, perturb_seed).label


@dataclass(frozen=True)
class Suite:
    """A page of the board.

    Args:
        title: what it is called.
        settings: name to setting; a row of the table each.
    """

    title: str
    settings: dict[str, Setting] = field(default_factory=dict)


def _settings(tasks: tuple[str, ...]) -> dict[str, Setting]:
    return {task: Setting(task, episodes=1 if task in FIXED else EPISODES) for task in tasks}


_PERTURBED = {CONTROL: Setting(PERTURBED_TASK)} | {
    axis: Setting(PERTURBED_TASK, perturb=f"{axis}={LEVEL}") for axis in AXES
}

SUITES = {
    "bins": Suite("Bins: put it in", _settings(TASKS_OF["bins"])),
    "ladder": Suite("Ladder: less and less clearance", _settings(TASKS_OF["ladder"])),
    "joints": Suite("Joints: set it flush", _settings(TASKS_OF["joints"])),
    "perturbed": Suite("Perturbed: one thing changed at a time", _PERTURBED),
}
"""Every suite of the board, by name."""


def class_of(suite: str, settings: Mapping[str, Setting], training_seeds: Iterable[int]) -> str:
    """`STANDARD` with a suite's settings and the protocol's seeds, else `CUSTOM`. It is compared, not declared."""
    is_standard = settings == SUITES[suite].settings and set(TRAINING_SEEDS) >= set(training_seeds)
    return STANDARD if is_standard else CUSTOM


def fresh_start(submission: str, value: str) -> int:
    """The first start of a re-run: known to nobody before `value` is.

    Args:
        submission: hash of the submission.
        value: a random number that was published after it, such as a round of drand or a pulse of NIST's beacon.
    """
    drawn = int.from_bytes(sha256(f"{submission}/{value.strip().lower()}".encode()).digest())
    return FIRST_FRESH + drawn % (2**30 - 10_000)


def fresh_settings(settings: dict[str, Setting], first_start: int) -> dict[str, Setting]:
    """The settings of a re-run: as those of a submission, from `RERUN_EPISODES` fresh starts."""
    return {
        name: Setting(
            setting.task,
            min(setting.episodes, RERUN_EPISODES),
            setting.episode_length,
            first_start,
            setting.perturb,
            setting.perturb_seed,
        )
        for name, setting in settings.items()
    }
