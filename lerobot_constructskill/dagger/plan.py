"""A DAgger run before anything runs: every policy, round and data set of it, each found by what makes it."""

from dataclasses import dataclass
from functools import cached_property
from typing import Any

from lerobot.configs import PreTrainedConfig

from lerobot_constructskill.artifacts.code import code_of
from lerobot_constructskill.artifacts.digests import versions
from lerobot_constructskill.artifacts.store import Artifact
from lerobot_constructskill.contract import Task, get_task
from lerobot_constructskill.dagger.settings import DaggerConfig
from lerobot_constructskill.demos.obtain import artifact
from lerobot_constructskill.demos.settings import GenerateConfig, check_apart
from lerobot_constructskill.envs.gym_env import resolve_rendering
from lerobot_constructskill.errors import InputError
from lerobot_constructskill.parsing import parse_named
from lerobot_constructskill.training.checkpoints import ACTING, check_inputs, checkpoint_artifact, settle_policy
from lerobot_constructskill.training.trainers import versions_of

DRIVING = (*ACTING, "av")
"""Packages whose versions may show in a round's frames, beside the policy's own."""


@dataclass(frozen=True)
class Plan:
    """What a configuration asks for. Policy 0 learns from the demonstrations, policy k from those of k rounds too.

    Raises:
        InputError: the base cannot be read, its labels are not the expert's, a start would be used twice, nothing can
            be a policy, or the policy is to drive and reads what the base does not show.
    """

    config: DaggerConfig

    @cached_property
    def base(self) -> GenerateConfig:
        flags = ["--repo_id=local/any", f"--workers={self.config.workers}", "--labels=advice"]
        base = parse_named(GenerateConfig, "generate", self.config.base, flags)
        if base.labels == "executed":
            raise InputError(
                f"The base '{self.config.base}' has executed actions as labels; DAgger needs the expert's."
            )
        check_apart({"demonstrations": base.starts, "rounds": self.config.starts, "evaluation": self.eval_seeds})
        return base

    @cached_property
    def policy(self) -> PreTrainedConfig:
        return settle_policy(self.config.policy)

    @property
    def task(self) -> Task:
        return get_task(self.base.task)

    @cached_property
    def env(self) -> dict[str, Any]:
        """Keywords of `ConstructSkillEnv` in every round, what they leave to the machine written out."""
        check_inputs(self.policy, self.base.obs_type)
        light_robot, backend = resolve_rendering(self.base.light_robot)
        length = self.config.max_steps or self.task.horizon
        return {
            "task": self.base.task,
            "obs_type": self.base.obs_type,
            "episode_length": length,
            "light_robot": light_robot,
            "render_backend": backend,
        }

    @cached_property
    def demonstrations(self) -> Artifact:
        return artifact(self.base)

    def data(self, number: int) -> Artifact:
        """The demonstrations and the first `number` rounds."""
        return self._chain[0][number]

    def checkpoint(self, number: int) -> Artifact:
        """Policy `number`."""
        return self._chain[1][number]

    def round(self, number: int) -> Artifact:
        """The frames of a round, counted from 1, in which policy `number - 1` drives."""
        return self._chain[2][number - 1]

    @cached_property
    def _chain(self) -> tuple[list[Artifact], list[Artifact], list[Artifact]]:
        """Data sets, policies and rounds in order, each found by those before it."""
        data, policies, rounds = [self.demonstrations], [], []
        for number in range(1, self.config.rounds + 1):
            policies.append(self._trained_on(data[-1]))
            rounds.append(self._driven_by(policies[-1], number))
            digests = [driven.digest for driven in rounds]
            data.append(Artifact("dagger", {"demonstrations": self.demonstrations.digest, "rounds": digests}))
        return data, [*policies, self._trained_on(data[-1])], rounds

    def _trained_on(self, data: Artifact) -> Artifact:
        return checkpoint_artifact(self.policy, self.config.training, self.config.seed, data.spec, stack=1)

    def _driven_by(self, policy: Artifact, number: int) -> Artifact:
        facts = {
            "number": number,
            "learner": policy.digest,
            "beta": self.config.beta(number),
            "seeds": [self.seeds(number).start, self.config.episodes],
            "expert": vars(self.base.expert),
            "environment": self.env,
            "patience": self.config.patience,
        }
        return Artifact("rounds", facts | {"versions": self._versions})

    def evaluation(self, number: int) -> Artifact:
        """How policy `number` does by itself."""
        seeds = [self.config.eval_seed, self.config.eval_episodes]
        facts = {"learner": self.checkpoint(number).digest, "seeds": seeds, "environment": self.env}
        return Artifact("evaluations", facts | {"versions": self._versions})

    def seeds(self, number: int) -> range:
        """Those of a round."""
        first = (number - 1) * self.config.episodes
        return self.config.starts[first : first + self.config.episodes]

    @property
    def eval_seeds(self) -> range:
        return range(self.config.eval_seed, self.config.eval_seed + self.config.eval_episodes)

    @cached_property
    def _versions(self) -> dict[str, str]:
        return versions(*DRIVING) | code_of(__name__, self.task.scene, self.task.expert) | versions_of(self.policy)
