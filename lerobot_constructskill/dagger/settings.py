"""The fields of `constructskill-dagger`."""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any

from lerobot_constructskill.bounds import Count, NotEmpty, Range, RepoId, Seed, Steps, Text, Workers, check
from lerobot_constructskill.errors import InputError
from lerobot_constructskill.training.recipe import Training

Beta = Annotated[float, Range(0, 1)]

ROUND_SEED_START = 2_000_000
"""Seed of the first episode of the first round; a data set's demonstrations start at `contract.DEMO_SEED_START`."""


@dataclass(frozen=True)
class DaggerConfig:
    """Train a policy on demonstrations; in each round it drives, the expert labels every state that it reaches, these
    frames are added, and the policy is trained again on all of them.

    Args:
        repo_id: the data set's name, `user/name`.
        policy: fields of a LeRobot policy, `type` among them.
        root: folder to write: `dataset`, `checkpoint` and `rounds.json`; `outputs/dagger/<name>` by default.
        store: folder of everything that is made on the way, each thing once for all commands.
        base: the demonstrations to begin with: a name or file that `constructskill-generate` takes, and flags over it.
            Its labels are advice like those of the rounds; `--labels=clean` leaves those that know the past.
        training: how the policy is trained; each time from the start.
        seed: training seed.
        rounds: how often the policy drives; with 0 it is behaviour cloning.
        episodes: episodes a round, of each task.
        max_steps: steps after which an episode ends without success; its task's horizon by default.
        betas: for each round the probability that a step executes the expert's action and not the policy's; the
            last one is also for the rounds that follow. The label is the expert's in every step.
        seed_start: seed of the first episode; the seeds count up through all rounds, and are the same in every task.
        patience: number of steps in a row, in which the expert knows no way to success, after which an episode ends.
        workers: processes that simulate.
        together: episodes that run at the same time.

    Raises:
        ValueError: a field holds what its annotation does not allow, or the policy has no type.
    """

    repo_id: RepoId
    policy: dict[str, Any]
    root: Text | None = None
    store: Path = Path("outputs/store")
    base: str = "fast_shifted_wrist"
    training: Training = field(default_factory=Training)
    seed: Seed = 0
    rounds: Annotated[int, Range(0, 1000)] = 3
    episodes: Count = 16
    max_steps: Steps | None = None
    betas: Annotated[list[Beta], NotEmpty()] = field(default_factory=lambda: [0.0])
    seed_start: Seed = ROUND_SEED_START
    patience: Steps = 20
    workers: Workers = 2
    together: Count = 8

    def __post_init__(self):
        check(self)
        if "type" not in self.policy:
            raise InputError("policy must name its type, such as 'type: frozen_vit'.")

    @property
    def starts(self) -> range:
        """Seeds of the episodes of all rounds, in every task."""
        return range(self.seed_start, self.seed_start + self.rounds * self.episodes)

    def beta(self, number: int) -> float:
        """The probability of the expert's action in a round, counted from 1."""
        return self.betas[min(number, len(self.betas)) - 1]
