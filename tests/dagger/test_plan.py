"""What a DAgger run's policies, rounds and data sets depend on, found without running any of them."""

from contextlib import nullcontext
from dataclasses import replace

import pytest

import lerobot_constructskill.plugin  # noqa: F401
from lerobot_constructskill.contract import TASKS
from lerobot_constructskill.dagger.plan import Plan
from lerobot_constructskill.dagger.settings import DaggerConfig
from lerobot_constructskill.errors import InputError
from lerobot_constructskill.parsing import parse
from lerobot_constructskill.presets import find, names
from lerobot_constructskill.study.plan import list_runs
from lerobot_constructskill.study.spec import Setting, Study, Variant
from lerobot_constructskill.training.recipe import Training

ACT = {"type": "act", "pretrained_backbone_weights": None}
FROZEN_VIT = {"type": "frozen_vit", "backbone": "dinov2_vits14"}
SEEN = "smoke --obs_type=pixels_agent_pos"
"""Demonstrations that show the state, which ACT reads."""
CONFIG = DaggerConfig("local/set", ACT, base=SEEN, rounds=3)


def made(**fields):
    plan = Plan.of(replace(CONFIG, **fields))
    rounds = [one.digest for number in (1, 2, 3) for one in plan.round(number)]
    return [plan.checkpoint(number).digest for number in range(4)], rounds


def test_every_policy_and_round_is_something_else():
    checkpoints, rounds = made()
    assert len({*checkpoints, *rounds}) == 7


@pytest.mark.parametrize("fields", [{"repo_id": "local/other"}, {"root": "x"}, {"workers": 1}, {"together": 1}])
def test_names_places_and_how_it_is_run_change_nothing(fields):
    assert made(**fields) == made()


def test_the_action_of_the_base_is_that_of_the_rounds():
    assert Plan.of(replace(CONFIG, base=f"{SEEN} --action=full")).envs[0]["action"] == "full"
    assert "action" not in Plan.of(CONFIG).envs[0]


def test_each_task_of_the_base_is_driven_in_its_own_environment_with_its_own_expert():
    plan = Plan.of(replace(CONFIG, base=f"{SEEN} --task=brick_to_bin,brick_on_brick --action=full --annotate=true"))
    rounds = plan.round(2)
    assert (
        [one.task.name for one in rounds] == ["brick_to_bin", "brick_on_brick"] == [*plan.base.config.task.split(",")]
    )
    assert [one.env["episode_length"] for one in rounds] == [TASKS[one.task.name].horizon for one in rounds]
    assert len({one.task.action_names for one in rounds}) == 1 and {one.env["action"] for one in rounds} == {"full"}
    assert len({one.digest for one in rounds}) == 2 and {one.seeds for one in rounds} == {plan.seeds(2)}
    merged = plan.data(2)
    assert [*merged.inputs] == ["demonstrations", "round_1_0", "round_1_1", "round_2_0", "round_2_1"]
    assert merged.parts == (plan.base, *plan.round(1), *rounds)


def test_rounds_and_merged_sets_of_one_task_are_what_they_were_before_there_were_several():
    """Their digests are of these, so that what stands in a store is found again."""
    plan = Plan.of(CONFIG)
    (driven,), merged = plan.round(2), plan.data(2)
    env = {"task": "brick_to_bin", "obs_type": "pixels_agent_pos", "episode_length": TASKS["brick_to_bin"].horizon}
    assert driven.facts() == {
        "number": 2,
        "beta": 0.0,
        "patience": 20,
        "seeds": [2_000_016, 2_000_032],
        "environment": env | {name: plan.envs[0][name] for name in ("light_robot", "render_backend")},
        "expert": vars(plan.base.config.expert),
        "video": "av1",
    }
    assert dict(driven.inputs) == {"policy": plan.checkpoint(1)} and merged.facts() == {}
    assert dict(merged.inputs) == {"demonstrations": plan.base, "round_1": plan.round(1)[0], "round_2": driven}


def test_language_columns_of_a_wall_are_refused_before_anything_runs():
    with pytest.raises(InputError, match="would not be exact in rounds of course_of_three"):
        Plan.of(replace(CONFIG, base=f"{SEEN} --task=course_of_three --annotate=true"))


def test_more_rounds_go_on_where_fewer_ended():
    assert Plan.of(replace(CONFIG, rounds=9)).checkpoint(3).digest == made()[0][3]


@pytest.mark.parametrize(
    "fields",
    [
        {"seed": 1},
        {"base": f"{SEEN} --episodes=5"},
        {"policy": ACT | {"dim_model": 64}},
        {"training": Training(epochs=1)},
    ],
)
def test_another_learner_is_another_run_from_the_start(fields):
    assert not {*sum(made(**fields), [])} & {*sum(made(), [])}


@pytest.mark.parametrize("fields", [{"episodes": 5}, {"max_steps": 9}, {"patience": 3}, {"betas": [0.5]}])
def test_another_way_to_drive_shares_the_policy_of_the_demonstrations_alone(fields):
    (first, *others), rounds = made(**fields)
    (same, *before), driven = made()
    assert first == same and not {*others, *rounds} & {*before, *driven}


@pytest.mark.parametrize("labels, taken", [("clean", True), ("advice", True), ("executed", False)])
def test_all_labels_are_the_experts_and_advice_if_nothing_else_is_asked_for(labels, taken):
    assert Plan.of(replace(CONFIG, base="fast_executed_labels")).base.config.labels == "advice"
    with nullcontext() if taken else pytest.raises(InputError, match="DAgger needs the expert's"):
        plan = Plan.of(replace(CONFIG, base=f"{SEEN} --labels={labels}"))
        assert (plan.round(1)[0].digest == made()[1][0]) is (labels == "advice")


def test_a_later_beta_changes_the_later_rounds_alone():
    assert made(betas=[0.0, 0.5])[1][0] == made()[1][0]
    assert made(betas=[0.0, 0.5])[1][1] != made()[1][1]


def test_seeds_of_rounds_never_meet():
    plan = Plan.of(CONFIG)
    seeds = [seed for number in (1, 2, 3) for seed in plan.seeds(number)]
    assert len(set(seeds)) == 3 * CONFIG.episodes and min(seeds) > max(plan.base.starts)


def test_a_hundred_rounds_are_planned_as_soon_as_three():
    plan = Plan.of(replace(CONFIG, rounds=100))
    assert plan.round(3)[0].digest == made()[1][2] and len({plan.data(number).digest for number in range(101)}) == 101


@pytest.mark.parametrize("policy, reads", [(ACT, True), (FROZEN_VIT, False), (FROZEN_VIT | {"use_state": True}, True)])
def test_what_a_policy_reads_the_base_has_to_show(policy, reads):
    _ = Plan.of(replace(CONFIG, policy=policy)).round(1)
    unseen = replace(CONFIG, policy=policy, base="smoke")
    _ = Plan.of(replace(unseen, rounds=0)).checkpoint(0)
    with pytest.raises(InputError, match="reads observation.state") if reads else nullcontext():
        Plan.of(unseen).round(1)


@pytest.mark.parametrize("name", names("dagger"))
def test_every_shipped_configuration_makes_a_plan(name):
    plan = Plan.of(parse(DaggerConfig, ["--repo_id=local/set"], find("dagger", name)))
    assert plan.checkpoint(plan.config.rounds).digest != plan.checkpoint(0).digest


def test_no_start_is_in_both_demonstrations_and_rounds():
    with pytest.raises(InputError, match="no start may be in both"):
        Plan.of(replace(CONFIG, seed_start=1_000_000))


def test_a_studys_variant_is_trained_on_the_rounds_that_each_of_its_seeds_drives():
    cloned = Variant(FROZEN_VIT, seeds=1, data="--labels=advice")
    variants = {"driven": Variant(FROZEN_VIT, seeds=2, dagger="smoke"), "cloned": cloned}
    study = Study("x", {"fixed": Setting("smoke")}, variants, training=Training(epochs=3))
    first, second, cloned = list_runs(study)
    config = parse(DaggerConfig, ["--repo_id=local/set"], find("dagger", "smoke"))
    for run in (first, second):
        plan = Plan.of(replace(config, policy=FROZEN_VIT, training=Training(epochs=3), seed=run.seed))
        assert run.checkpoints == plan.checkpoint(config.rounds)
    alone, stacked = first.plan.checkpoint(0).spec, cloned.checkpoints.spec
    assert stacked == alone | {"seeds": [0, 10]}, "who drives is trained alone: each seed has rounds of its own"
    assert first.checkpoints != second.checkpoints


def test_a_studys_rounds_begin_with_the_variants_own_demonstrations():
    driven = Variant(ACT, seeds=1, data="--episodes=1", dagger="smoke --rounds=2")
    (run,) = list_runs(Study("x", {"fixed": Setting("fast", {"obs_type": "pixels_agent_pos"})}, {"driven": driven}))
    base = run.plan.base.config
    assert (base.episodes, base.noise.sigma, base.labels, run.plan.config.rounds) == (1, 0.01, "advice", 2)
    assert run.arm.demonstrations.name == "fast --episodes=1 --labels=advice"
