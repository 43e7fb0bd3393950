"""The plan of a DAgger run: its policies, rounds and data sets as nodes, before any of them is made."""

from dataclasses import dataclass
from functools import cached_property
from itertools import chain
from typing import Any

from lerobot_constructskill.contract import TASK_ACTION
from lerobot_constructskill.dagger.merge import MergedSet
from lerobot_constructskill.dagger.rounds import Round
from lerobot_constructskill.dagger.settings import DaggerConfig
from lerobot_constructskill.demos.node import Demonstrations
from lerobot_constructskill.demos.settings import GenerateConfig, check_apart
from lerobot_constructskill.envs.gym_env import resolve_rendering
from lerobot_constructskill.errors import InputError
from lerobot_constructskill.parsing import parse_named
from lerobot_constructskill.training.checkpoints import Checkpoints, check_inputs
from lerobot_constructskill.training.recipe import Training
from lerobot_constructskill.training.trainers import Learner


@dataclass(frozen=True, eq=False)
class Plan:
    """Policy 0 learns from the demonstrations, policy k from those and k rounds, in each of which the last one drove.

    Args:
        config: the rounds. Its base, policy, training and seed are not read.
        base: the demonstrations to begin with.
        learner: what is trained.
        training: how.
        seed: the training seed.

    Raises:
        InputError: the base has labels that are not the expert's or annotated walls, or a start would be used twice.
    """

    config: DaggerConfig
    base: Demonstrations
    learner: Learner
    training: Training
    seed: int

    def __post_init__(self):
        walls = [row.name for row in self.base.config.rows if row.plan is not None]
        if self.base.config.annotate and walls:
            raise InputError(
                f"Language columns would not be exact in rounds of {walls[0]}, where a policy may go back to an "
                "element within a phase: generate the base without annotate."
            )
        if self.base.config.labels == "executed":
            raise InputError("The base has executed actions as labels; DAgger needs the expert's.")
        check_apart({"demonstrations": self.base.starts, "rounds": self.config.starts})

    @classmethod
    def of(cls, config: DaggerConfig) -> "Plan":
        """The plan of a whole configuration.

        Raises:
            InputError: the base cannot be read, or nothing can be a policy.
        """
        base = parse_named(GenerateConfig, "generate", config.base, ["--repo_id=local/any", "--labels=advice"])
        return cls(config, Demonstrations(base), Learner.of(config.policy), config.training, config.seed)

    @cached_property
    def envs(self) -> list[dict[str, Any]]:
        """Keywords of `ConstructSkillEnv` for each task in every round, with all that is left to the machine.

        Raises:
            InputError: the policy reads what the base does not show.
        """
        base = self.base.config
        check_inputs(self.learner.config, base.obs_type, base.seen)
        light_robot, backend = resolve_rendering(base.light_robot)
        shown = {"cameras": base.seen} if base.cameras else {}
        acting = {} if base.action == TASK_ACTION else {"action": base.action}
        return [
            {
                "task": task.name,
                "obs_type": base.obs_type,
                "episode_length": self.config.max_steps or task.horizon,
                "light_robot": light_robot,
                "render_backend": backend,
            }
            | shown
            | acting
            for task in base.rows
        ]

    def data(self, number: int) -> Demonstrations | MergedSet:
        """What policy `number` is trained on: the demonstrations and the first `number` rounds."""
        return self._chain[0][number]

    def checkpoint(self, number: int) -> Checkpoints:
        """Policy `number`."""
        return self._chain[1][number]

    def round(self, number: int) -> tuple[Round, ...]:
        """The frames of a round, counted from 1, of each task, in which policy `number - 1` drives."""
        return self._chain[2][number - 1]

    @cached_property
    def _chain(self) -> tuple[list[Demonstrations | MergedSet], list[Checkpoints], list[tuple[Round, ...]]]:
        """Data sets, policies and rounds in order."""
        data: list[Demonstrations | MergedSet] = [self.base]
        policies, rounds = [self._trained_on(self.base)], []
        for number in range(1, self.config.rounds + 1):
            rounds.append(self._driven_by(policies[-1], number))
            data.append(MergedSet(self.base, tuple(chain(*rounds))))
            policies.append(self._trained_on(data[-1]))
            assert policies[-1].digest  # now, where few calls are nested: a hundred rounds would be too many
        return data, policies, rounds

    def _trained_on(self, data: Demonstrations | MergedSet) -> Checkpoints:
        return Checkpoints.holding(self.seed, self.learner, self.training, data, alone=True)

    def _driven_by(self, policy: Checkpoints, number: int) -> tuple[Round, ...]:
        how = self.seeds(number), number, self.config.beta(number), self.config.patience
        return tuple(Round(policy, self.base, env, *how) for env in self.envs)

    def seeds(self, number: int) -> range:
        """Seeds of the episodes of a round, in every task."""
        first = (number - 1) * self.config.episodes
        return self.config.starts[first : first + self.config.episodes]
