"""From a study to its runs: all that a run depends on is read, checked and written out before anything runs."""

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass, replace
from functools import cached_property
from typing import Any

from lerobot.configs import PreTrainedConfig
from lerobot.envs import EnvConfig

from lerobot_constructskill.artifacts.code import code_of
from lerobot_constructskill.artifacts.digests import versions
from lerobot_constructskill.artifacts.store import Artifact
from lerobot_constructskill.contract import get_task
from lerobot_constructskill.dagger.plan import Plan
from lerobot_constructskill.dagger.settings import DaggerConfig
from lerobot_constructskill.demos.obtain import artifact
from lerobot_constructskill.demos.settings import GenerateConfig, check_apart
from lerobot_constructskill.envs.gym_env import resolve_rendering
from lerobot_constructskill.errors import InputError, UserError
from lerobot_constructskill.parsing import decode, parse_named
from lerobot_constructskill.policy_types import decode_policy
from lerobot_constructskill.rollout.references import REFERENCES, Reference
from lerobot_constructskill.study.rows import REFERENCE, SIGHTLESS, VARIANT
from lerobot_constructskill.study.spec import SHARED, Study, Variant
from lerobot_constructskill.training.checkpoints import (
    ACTING,
    check_inputs,
    checkpoint_artifact,
    settle_policy,
    settled_elsewhere,
)
from lerobot_constructskill.training.recipe import Training
from lerobot_constructskill.training.trainers import trainer_of, versions_of

OURS = "constructskill"
"""The one environment that a study evaluates in."""

MAKES_RUNS, MEASURES_ERRORS = "lerobot_constructskill.study.execute", "lerobot_constructskill.rollout.heldout"
"""Modules whose rooms show in a run's episodes, and in held-out errors."""

SEEDS_APART = 2_000
"""From the first attempt's seed of a training seed's own demonstrations to that of the next one's."""


@dataclass(frozen=True)
class Demonstrations:
    """A data set that a study names.

    Args:
        name: what it is called.
        config: what it is generated from.
        moved: by how much its attempts' seeds are moved: 0 but for a training seed's own draw.
    """

    name: str
    config: GenerateConfig
    moved: int = 0

    @cached_property
    def artifact(self) -> Artifact:
        return artifact(self.config)

    def drawn_for(self, seed: int) -> "Demonstrations":
        """A training seed's own draw of it; that of seed 0 is what all seeds would share.

        Raises:
            InputError: two of them could have attempts in common.
        """
        attempts = self.config.episodes * (1 + self.config.max_failures)
        if attempts > SEEDS_APART:
            raise InputError(
                f"{self.name} may take {attempts:,.0f} attempts; of demonstrations that each training seed has of its "
                f"own, none may take more than {SEEDS_APART:,} (episodes, and max_failures times as many)."
            )
        moved = seed * SEEDS_APART
        return replace(self, config=replace(self.config, seed_start=self.config.seed_start + moved), moved=moved)


@dataclass(frozen=True, eq=False)
class Arm:
    """A variant or a reference in one setting: its runs differ in their seed alone.

    Args:
        setting, name, role: as in `rows.Row`.
        env: keyword arguments of `ConstructSkillEnv`.
        evaluation: `seed` of the first episode, and how many `episodes`.
        demonstrations: what it learns from or replays, if it does.
        validated_on: all demonstrations of its setting, those that every seed would share.
        policy: settled configuration of what is trained; None for references that are not.
        training: how.
        dagger: whose rounds it is trained on beside the demonstrations, if it is.
        elsewhere: the same as machines of another kind would settle its policy.
    """

    setting: str
    name: str
    role: str
    env: dict[str, Any]
    evaluation: dict[str, int]
    demonstrations: Demonstrations | None
    validated_on: tuple[Demonstrations, ...] = ()
    policy: PreTrainedConfig | None = None
    training: Training | None = None
    dagger: DaggerConfig | None = None
    elsewhere: tuple["Arm", ...] = ()

    @property
    def id(self) -> str:
        return f"{self.setting}/{self.name}"

    @property
    def stack(self) -> int:
        """How many of its seeds are trained as one computation: where each has demonstrations of its own, none are."""
        own = self.demonstrations.moved or self.dagger
        return 1 if own else trainer_of(self.policy).stack(self.policy)

    @property
    def trained_on(self) -> Demonstrations | None:
        """The demonstrations that are all it is trained on; none where DAgger adds rounds to them.

        Of these alone the trainer's own held-out error speaks.
        """
        return None if self.dagger else self.demonstrations


@dataclass(frozen=True, eq=False)
class Run:
    """One training seed of an arm: the unit of evidence. Its names are no part of its specification."""

    arm: Arm
    seed: int

    @property
    def id(self) -> str:
        return f"{self.arm.id}/seed_{self.seed}"

    @cached_property
    def dagger(self) -> Plan | None:
        """The rounds that it drives itself."""
        return Plan(replace(self.arm.dagger, seed=self.seed)) if self.arm.dagger else None

    @cached_property
    def checkpoint(self) -> Artifact | None:
        """What it trains."""
        arm = self.arm
        if arm.policy is None:
            return None
        if self.dagger:
            return self.dagger.checkpoint(arm.dagger.rounds)
        return checkpoint_artifact(arm.policy, arm.training, self.seed, arm.demonstrations.artifact.spec, arm.stack)

    @cached_property
    def artifact(self) -> Artifact:
        """Its episodes."""
        arm = self.arm
        agent = {"checkpoint": self.checkpoint.spec} if self.checkpoint else {"reference": arm.name, "seed": self.seed}
        if self.checkpoint is None and arm.demonstrations:
            agent["demonstrations"] = arm.demonstrations.artifact.spec
        facts = {"environment": arm.env, "evaluation": arm.evaluation, "versions": self.versions}
        return Artifact("runs", agent | facts)

    @cached_property
    def digests(self) -> tuple[str, ...]:
        """That of its episodes, and those that they have where machines of another kind made them."""
        return self.artifact.digest, *(Run(arm, self.seed).artifact.digest for arm in self.arm.elsewhere)

    @cached_property
    def versions(self) -> dict[str, str]:
        """What the packages are that may show in its episodes."""
        policy, reference = self.arm.policy, REFERENCES.get(self.arm.name)
        task = get_task(self.arm.env["task"])
        seen = [task.expert] if reference and reference.is_expert else []
        own = versions_of(policy) if policy else code_of(reference.agent.__module__, *seen)
        return versions(*ACTING) | code_of(task.scene, MAKES_RUNS) | own

    def heldout(self, demonstrations: Demonstrations) -> Artifact:
        """Its translation error on what is held out of some demonstrations."""
        on = {"demonstrations": demonstrations.artifact.spec, "holdout": self.arm.training.holdout}
        on |= {"versions": code_of(MEASURES_ERRORS)}
        return Artifact("heldout", {"checkpoint": self.checkpoint.spec, **on})


def list_runs(study: Study) -> list[Run]:
    """Every run of a study: the references of each setting, then its variants, in the study's order.

    Raises:
        InputError: a field, anywhere in the study, that nothing can be run with; the message names it.
    """
    runs = []
    for name, setting in study.settings.items():
        with _inside(f"settings.{name}.env"):
            env = resolve_env(setting.env)
        sets = {data: _read_demonstrations(name, data) for data in study.data_of(name)}
        evaluation = {"seed": study.eval_seed, "episodes": study.episodes}
        starts = range(study.eval_seed, study.eval_seed + study.episodes)
        for data in sets.values():
            check_apart({f"demonstrations '{data.name}'": data.config.starts, "evaluation": starts})
        common = {"setting": name, "env": env, "evaluation": evaluation, "validated_on": tuple(sets.values())}
        for reference, count in study.references.items():
            for seeds, drawn in _draws(study, range(count), sets):
                arm = _reference_arm(study, reference, drawn, common)
                runs += [Run(arm, seed) for seed in seeds]
        for variant_name, variant in study.variants_in(name).items():
            for seeds, drawn in _draws(study, variant.training_seeds, sets):
                arm = _variant_arm(study, variant_name, variant, drawn[study.data_for(name, variant)], common)
                runs += [Run(arm, seed) for seed in seeds]
    return runs


def _draws(
    study: Study, seeds: range, sets: dict[str, Demonstrations]
) -> Iterator[tuple[Sequence[int], dict[str, Demonstrations]]]:
    """Training seeds, and the demonstrations of a setting that they all learn from."""
    if study.demonstrations == SHARED:
        yield seeds, sets
        return
    for seed in seeds:
        yield [seed], {name: one.drawn_for(seed) for name, one in sets.items()}


def _variant_arm(study: Study, name: str, variant: Variant, data: Demonstrations, common: Mapping[str, Any]) -> Arm:
    with _inside(f"variants.{name}.policy"):
        policy = settle_policy(variant.policy)
        check_inputs(policy, common["env"]["obs_type"])
        others = settled_elsewhere(variant.policy)
    training = _training_of(study, common["setting"], name, variant)
    learnt = {"demonstrations": data, "policy": policy, "training": training}
    if variant.dagger:
        rounds = _dagger_config(variant)
        if len(rounds.starts) > SEEDS_APART and study.demonstrations != SHARED:
            raise InputError(
                f"variants.{name}.dagger: where each training seed has demonstrations of its own, all rounds together "
                f"may have {SEEDS_APART:,} episodes at most, not {len(rounds.starts):,}."
            )
        base = f"{data.name} --seed_start={data.config.seed_start}" if data.moved else data.name
        start = rounds.seed_start + data.moved
        learnt["dagger"] = replace(rounds, base=base, seed_start=start, policy=variant.policy, training=training)
    with _inside(f"variants.{name}"):
        first = study.eval_seed
        starts = {"demonstrations": data.config.starts, "evaluation": range(first, first + study.episodes)}
        if variant.dagger:
            starts["rounds"] = learnt["dagger"].starts
        check_apart(starts)
    elsewhere = (_variant_arm(study, name, replace(variant, policy=other), data, common) for other in others)
    return Arm(name=name, role=VARIANT, elsewhere=tuple(elsewhere), **learnt, **common)


def _dagger_config(variant: Variant) -> DaggerConfig:
    with _inside(f"dagger {variant.dagger}"):
        return parse_named(DaggerConfig, "dagger", variant.dagger, ["--repo_id=local/any"])


def _reference_arm(study: Study, name: str, sets: Mapping[str, Demonstrations], common: Mapping[str, Any]) -> Arm:
    if name not in REFERENCES:
        raise InputError(f"Unknown reference '{name}'; the references are: {', '.join(REFERENCES)}.")
    reference, setting = REFERENCES[name], common["setting"]
    arm = Arm(name=name, role=REFERENCE if reference.looks else SIGHTLESS, demonstrations=None, **common)
    if reference.policy:
        base, variant = _variant_with(study, name, reference, setting)
        with _inside(f"references.{name}"):
            fields = {**variant.policy, **reference.policy}
            policies = [settle_policy(one) for one in (fields, *settled_elsewhere(fields))]
            check_inputs(policies[0], common["env"]["obs_type"])
        training = _training_of(study, setting, base, variant)
        data = sets[study.data_for(setting, variant)]
        here, *elsewhere = [replace(arm, demonstrations=data, policy=one, training=training) for one in policies]
        return replace(here, elsewhere=tuple(elsewhere))
    data = sets[study.settings[setting].data] if reference.reads_demonstrations else None
    return replace(arm, demonstrations=data, validated_on=())


def _variant_with(study: Study, name: str, reference: Reference, setting: str) -> tuple[str, Variant]:
    """The first variant in a setting, none of DAgger's, whose policy has the fields that a reference sets."""
    for of_variant, variant in study.variants_in(setting).items():
        if variant.dagger:
            continue
        with _inside(f"variants.{of_variant}.policy"):
            kind = type(decode_policy(variant.policy))
        if all(hasattr(kind, field) for field in reference.policy):
            return of_variant, variant
    fields = ", ".join(reference.policy)
    raise InputError(f"The reference '{name}' needs a variant whose policy has {fields}, as frozen_vit has.")


def _training_of(study: Study, setting: str, name: str, variant: Variant) -> Training:
    with _inside(f"settings.{setting}.training"):
        training = decode(Training, {**asdict(study.training), **study.settings[setting].training})
    with _inside(f"variants.{name}.training"):
        return decode(Training, {**asdict(training), **variant.training})


def resolve_env(fields: Mapping[str, Any]) -> dict[str, Any]:
    """Every keyword of the environment, with whatever it leaves to the task and the machine written out."""
    if fields.get("type", OURS) != OURS:
        raise InputError(f"type must be {OURS}, not {fields['type']!a}: a study evaluates in no other environment.")
    env = decode(EnvConfig, {**fields, "type": OURS}).gym_kwargs
    task = get_task(env["task"])  # one: a setting is no suite
    length = env["episode_length"] or task.horizon
    light_robot, backend = resolve_rendering(env["light_robot"], env["render_backend"])
    return env | {"episode_length": length, "light_robot": light_robot, "render_backend": backend}


def _read_demonstrations(setting: str, data: str) -> Demonstrations:
    with _inside(f"settings.{setting}, data {data}"):
        return Demonstrations(data, parse_named(GenerateConfig, "generate", data, ["--repo_id=local/any"]))


@contextmanager
def _inside(where: str) -> Iterator[None]:
    """Say in which part of the study a field lies that cannot be used."""
    try:
        yield
    except UserError as error:
        raise type(error)(f"{where}: {error}") from error
