"""The plan of a DAgger run: its policies, rounds and data sets as nodes, before any of them is made."""

from dataclasses import dataclass
from functools import cached_property
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
        InputError: the base has several tasks or labels that are not the expert's, or a start would be used twice.
    """

    config: DaggerConfig
    base: Demonstrations
    learner: Learner
    training: Training
    seed: int

    def __post_init__(self):
        if len(self.base.config.rows) > 1:
            raise InputError(f"DAgger's rounds are of one task; the base has several, {self.base.config.task}.")
        if self.base.config.annotate:
            raise InputError("The base has language columns, which rounds have not: generate it without annotate.")
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
    def env(self) -> dict[str, Any]:
        """Keywords of `ConstructSkillEnv` in every round, with what they leave to the machine written out.

        Raises:
            InputError: the policy reads what the base does not show.
        """
        base, (task,) = self.base.config, self.base.config.rows
        check_inputs(self.learner.config, base.obs_type, base.seen)
        light_robot, backend = resolve_rendering(base.light_robot)
        acting = {} if base.action == TASK_ACTION else {"action": base.action}
        return (
            {
                "task": task.name,
                "obs_type": base.obs_type,
                "episode_length": self.config.max_steps or task.horizon,
                "light_robot": light_robot,
                "render_backend": backend,
            }
            | ({"cameras": base.seen} if base.cameras else {})
            | acting
        )

    def data(self, number: int) -> Demonstrations | MergedSet:
        """What policy `number` is trained on: the demonstrations and the first `number` rounds."""
        return self._chain[0][number]

    def checkpoint(self, number: int) -> Checkpoints:
        """Policy `number`."""
        return self._chain[1][number]

    def round(self, number: int) -> Round:
        """The frames of a round, counted from 1, in which policy `number - 1` drives."""
        return self._chain[2][number - 1]

    @cached_property
    def _chain(self) -> tuple[list[Demonstrations | MergedSet], list[Checkpoints], list[Round]]:
        """Data sets, policies and rounds in order."""
        data, policies, rounds = [self.base], [self._trained_on(self.base)], []
        for number in range(1, self.config.rounds + 1):
            rounds.append(self._driven_by(policies[-1], number))
            data.append(MergedSet(self.base, tuple(rounds)))
            policies.append(self._trained_on(data[-1]))
            assert policies[-1].digest  # now, where few calls are nested: a hundred rounds would be too many
        return data, policies, rounds

    def _trained_on(self, data: Demonstrations | MergedSet) -> Checkpoints:
        return Checkpoints.holding(self.seed, self.learner, self.training, data, alone=True)

    def _driven_by(self, policy: Checkpoints, number: int) -> Round:
        seeds, config = self.seeds(number), self.config
        return Round(policy, self.base, self.env, seeds, number, config.beta(number), config.patience)

    def seeds(self, number: int) -> range:
        """Seeds of the episodes of a round."""
        first = (number - 1) * self.config.episodes
        return self.config.starts[first : first + self.config.episodes]
