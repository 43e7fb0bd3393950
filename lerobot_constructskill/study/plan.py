"""From a study to its runs: all that a run depends on is read, checked and written out before anything runs."""

from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass, replace
from itertools import chain, groupby
from typing import Any

from lerobot.envs import EnvConfig

from lerobot_constructskill.contract import ANY_ACTION, TASK_ACTION, get_task
from lerobot_constructskill.dagger.plan import Plan
from lerobot_constructskill.dagger.settings import DaggerConfig
from lerobot_constructskill.demos.node import Demonstrations
from lerobot_constructskill.demos.settings import GenerateConfig, check_apart
from lerobot_constructskill.envs.gym_env import resolve_rendering
from lerobot_constructskill.errors import InputError, UserError
from lerobot_constructskill.parsing import decode, parse_named
from lerobot_constructskill.policy_types import decode_policy
from lerobot_constructskill.rollout.references import REFERENCES, Reference
from lerobot_constructskill.study.rows import OWN, REFERENCE, SHARED, SIGHTLESS, VARIANT
from lerobot_constructskill.study.runs import Arm, NamedSet, Run, told_in
from lerobot_constructskill.study.spec import Study, Variant
from lerobot_constructskill.training.checkpoints import check_inputs
from lerobot_constructskill.training.recipe import Training
from lerobot_constructskill.training.trainers import Learner

OURS = "constructskill"
"""The one environment that a study evaluates in."""

SEEDS_APART = 2_000
"""From the first attempt's seed of a draw of demonstrations to that of the next one's."""


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
        _check_actions(name, env, sets.values())
        common = {"setting": name, "env": env, "validated_on": tuple(sets.values())}
        for reference, count in study.references.items():
            for draw in _draws(study, range(count), sets):
                arm = _reference_arm(study, reference, draw.sets, common | {"starts": draw.starts})
                runs += [Run(arm, seed) for seed in draw.seeds]
        for variant_name, variant in study.variants_in(name).items():
            for draw in _draws(study, variant.training_seeds, sets):
                data = draw.sets[study.data_for(name, variant)]
                arm = _variant_arm(study, variant_name, variant, data, common | {"starts": draw.starts})
                runs += [Run(arm, seed) for seed in draw.seeds]
    return runs


def _check_actions(setting: str, env: Mapping[str, Any], sets: Iterable[NamedSet]) -> None:
    """Refuse demonstrations whose actions are not those of the environment."""
    acts_in = get_task(env["task"], env.get("action", TASK_ACTION)).action_names
    for one in sets:
        if (shown := one.node.config.rows[0].action_names) != acts_in:
            raise InputError(
                f"settings.{setting}: the actions of '{one.name}' are {shown}, those of its env {acts_in}: give both "
                f"`action: {ANY_ACTION}`."
            )


@dataclass(frozen=True)
class _Draw:
    """Training seeds that have in common what they learn from and where they are evaluated.

    Args:
        seeds: the training seeds.
        sets: the demonstrations of a setting, by name.
        starts: seeds of the evaluation episodes.
    """

    seeds: Sequence[int]
    sets: dict[str, NamedSet]
    starts: range


def _draws(study: Study, seeds: range, sets: dict[str, NamedSet]) -> Iterator[_Draw]:
    """The draws of some training seeds of a setting with these demonstrations.

    Raises:
        InputError: demonstrations could begin as an evaluation episode of one of these draws does, or as those of
            another draw.
    """
    first, last = (study.starts_of(study.draws.of(seed)) for seed in (seeds[0], seeds[-1]))
    if study.demonstrations == OWN:
        for one in sets.values():
            _check_room(one)
    for number, own in groupby(seeds, key=study.draws.of):
        drawn = {name: _drawn(number, one) for name, one in sets.items()} if number else sets
        for one in drawn.values():
            evaluated = {"evaluation": range(first.start, last.stop)}
            check_apart({f"demonstrations '{one.name}'": one.node.starts} | evaluated)
        yield _Draw([*own], drawn, study.starts_of(number))


def _check_room(data: NamedSet) -> None:
    """Refuse demonstrations of which two draws could have attempts in common."""
    config = data.node.config
    attempts = config.episodes * (1 + config.max_failures)
    if attempts > SEEDS_APART:
        raise InputError(
            f"{data.name} may take {attempts:,.0f} attempts; of demonstrations that each draw has of its own, none "
            f"may take more than {SEEDS_APART:,} (episodes, and max_failures times as many)."
        )


def _drawn(draw: int, data: NamedSet) -> NamedSet:
    """A draw of some demonstrations; draw 0 has those that all seeds would share."""
    config, moved = data.node.config, draw * SEEDS_APART
    return NamedSet(data.name, Demonstrations(replace(config, seed_start=config.seed_start + moved)), moved)


def _variant_arm(study: Study, name: str, variant: Variant, data: NamedSet, common: Mapping[str, Any]) -> Arm:
    with _inside(f"variants.{name}.policy"):
        learner = Learner.of(variant.policy)
        check_inputs(learner.config, common["env"]["obs_type"], data.node.config.seen)
        _check_told(learner, data, common)
    starts = {"demonstrations": data.node.starts, "evaluation": common["starts"]}
    rounds = _rounds(study, name, variant, data) if variant.dagger else None
    training = _training_of(study, common["setting"], name, variant)
    with _inside(f"variants.{name}"):
        check_apart(starts | ({"rounds": rounds.starts} if rounds else {}))
        if rounds:
            Plan(rounds, data.node, learner, training, variant.first_seed)  # which refuses what cannot be driven
    return Arm(
        name=name, role=VARIANT, demonstrations=data, learner=learner, training=training, rounds=rounds, **common
    )


def _check_told(learner: Learner, data: NamedSet, common: Mapping[str, Any]) -> None:
    """Refuse an instruction that a policy which is told one will not know: that of no task that it learns from.

    A sentence encoder also takes other wordings of these tasks; told by number, a policy knows the trained ones alone.
    """
    language = getattr(learner.config, "language", None)
    if language is None:
        return
    env, tasks, levels = common["env"], data.node.config.rows, 1 if language == "number" else None
    known = {word for task in tasks for word in (task.instruction, *chain(*task.rewordings[:levels]))}
    if (asked := told_in(env)) not in known:
        raise InputError(
            f"In settings.{common['setting']} it is told '{asked}', which it cannot learn from '{data.name}': train "
            "on the task that is asked so, or evaluate another."
        )


def _rounds(study: Study, name: str, variant: Variant, data: NamedSet) -> DaggerConfig:
    """The rounds of a variant, which begin elsewhere where its demonstrations do."""
    with _inside(f"dagger {variant.dagger}"):
        rounds = parse_named(DaggerConfig, "dagger", variant.dagger, ["--repo_id=local/any"])
    if len(rounds.starts) > SEEDS_APART and study.demonstrations != SHARED:
        raise InputError(
            f"variants.{name}.dagger: where each training seed has demonstrations of its own, all rounds together "
            f"may have {SEEDS_APART:,} episodes at most, not {len(rounds.starts):,}."
        )
    return replace(rounds, seed_start=rounds.seed_start + data.moved)


def _reference_arm(study: Study, name: str, sets: Mapping[str, NamedSet], common: Mapping[str, Any]) -> Arm:
    if name not in REFERENCES:
        raise InputError(f"Unknown reference '{name}'; the references are: {', '.join(REFERENCES)}.")
    reference, setting = REFERENCES[name], common["setting"]
    role = REFERENCE if reference.looks else SIGHTLESS
    if reference.policy:
        base, variant = _variant_with(study, name, reference, setting)
        data = sets[study.data_for(setting, variant)]
        with _inside(f"references.{name}"):
            learner = Learner.of({**variant.policy, **reference.policy})
            check_inputs(learner.config, common["env"]["obs_type"], data.node.config.seen)
        training = _training_of(study, setting, base, variant)
        return Arm(name=name, role=role, demonstrations=data, learner=learner, training=training, **common)
    data = sets[study.settings[setting].data] if reference.reads_demonstrations else None
    return Arm(name=name, role=role, demonstrations=data, **common | {"validated_on": ()})


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


def _read_demonstrations(setting: str, data: str) -> NamedSet:
    with _inside(f"settings.{setting}, data {data}"):
        config = parse_named(GenerateConfig, "generate", data, ["--repo_id=local/any"])
    return NamedSet(data, Demonstrations(config))


@contextmanager
def _inside(where: str) -> Iterator[None]:
    """Say in which part of the study a field lies that cannot be used."""
    try:
        yield
    except UserError as error:
        raise type(error)(f"{where}: {error}") from error
