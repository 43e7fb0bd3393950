"""What a study's runs depend on, and what they do not: found without running any of them."""

import json
import shutil
from contextlib import nullcontext
from dataclasses import replace
from errno import ENOENT, ENOSPC, ESTALE
from pathlib import Path
from types import SimpleNamespace

import httpx
import pandas as pd
import pytest
import torch

import lerobot_constructskill.plugin  # noqa: F401
from lerobot_constructskill.analysis.section import Analysis
from lerobot_constructskill.artifacts import pools, revisions
from lerobot_constructskill.artifacts.failures import Failure
from lerobot_constructskill.artifacts.processor import processor
from lerobot_constructskill.artifacts.revisions import BEFORE
from lerobot_constructskill.artifacts.store import LOG, Machine, Store
from lerobot_constructskill.contract import get_task
from lerobot_constructskill.errors import InputError, MachineError, UserError, kind_of
from lerobot_constructskill.plans.plan import written
from lerobot_constructskill.policies.frozen_vit import precision
from lerobot_constructskill.policies.frozen_vit.precision import PRECISIONS
from lerobot_constructskill.scripts.study import StudyConfig, text_of
from lerobot_constructskill.scripts.study import study as study_command
from lerobot_constructskill.study import runs as runs_module
from lerobot_constructskill.study import session
from lerobot_constructskill.study.plan import SEEDS_APART, list_runs, resolve_env
from lerobot_constructskill.study.rows import (
    NOT_RUN,
    PROVENANCE,
    ROWS,
    STUDY,
    EpisodeRow,
    Row,
    load_rows,
    read_environments,
    read_rows,
    write_rows,
)
from lerobot_constructskill.study.runs import EPISODES, Job, make_runs
from lerobot_constructskill.study.session import choose, run_study
from lerobot_constructskill.study.spec import Options, Setting, Study, Variant
from lerobot_constructskill.study.status import status
from lerobot_constructskill.study.table import Table
from lerobot_constructskill.study.timing import TIMINGS, entries, time_by_stage, timed
from lerobot_constructskill.study.validate import heldout, list_pairs, validate
from lerobot_constructskill.training.heldout import FILE
from lerobot_constructskill.training.recipe import Training

ACT = {"type": "act", "pretrained_backbone_weights": None}
"""A policy that needs no weights from anywhere; it reads the state."""

ENV = {"episode_length": 8, "obs_type": "pixels_agent_pos"}


def study(**fields) -> Study:
    given = {
        "name": "x",
        "settings": {"fixed": Setting("smoke", ENV)},
        "variants": {"a": Variant(ACT, seeds=3), "b": Variant(ACT | {"dim_model": 64}, seeds=2)},
        "references": {"no_op": 1, "replay": 1},
        "episodes": 2,
    }
    return Study(**given | fields)


def digests(of: Study) -> dict[str, str]:
    return {run.id: run.digest for run in list_runs(of)}


def changed(before: Study, after: Study) -> set[str]:
    """The runs of `after` that those of `before` do not hold."""
    there = set(digests(before).values())
    return {name for name, digest in digests(after).items() if digest not in there}


def make_all(of: Study, root: Path) -> Table:
    """Every run is there already; the last was made first."""
    store = Store(root / "store")
    for run in reversed(list_runs(of)):
        with store.claim([run]) as missing:
            for artifact in missing:
                with store.writing(artifact) as folder:
                    folder.mkdir()
                    row = EpisodeRow(run=run.digest, training_seed=run.seed, evaluation_seed=1000, episode=0)
                    row = replace(row, versions=json.dumps(run.spec["versions"]))
                    write_rows([row], folder / EPISODES, EpisodeRow)
    return run_study(of, "", root / of.name, store, Options())


def test_thirty_seeds_after_ten_are_twenty_runs():
    ten, thirty = (study(variants={"a": Variant(ACT, seeds=seeds)}) for seeds in (10, 30))
    assert changed(ten, thirty) == {f"fixed/a/seed_{seed}" for seed in range(10, 30)}
    elsewhere = study(variants={"a": Variant(ACT, seeds=2, first_seed=100)})
    assert changed(ten, elsewhere) == {"fixed/a/seed_100", "fixed/a/seed_101"}


def test_a_part_of_a_study_is_validated_on_no_demonstrations_of_the_rest():
    frozen_vit = {"type": "frozen_vit", "backbone": "dinov2_vits14"}
    own, more, most = "smoke", "smoke --episodes=4", "smoke --episodes=8"
    settings = {"fixed": Setting("smoke", ENV), "alone": Setting("fast", ENV)}
    variants = {
        "own": Variant(frozen_vit, seeds=2, settings=["fixed"]),
        "more": Variant(frozen_vit, seeds=2, data="--episodes=4", settings=["fixed"]),
        "most": Variant(frozen_vit, seeds=2, data="--episodes=8"),
    }
    runs = list_runs(study(settings=settings, variants=variants))

    def validated(only: str) -> set[tuple[str, str, str]]:
        chosen = choose(runs, only)
        pairs = list_pairs(chosen, [run for run in runs if run not in chosen])
        return {(arm.setting, arm.name, data.name) for arm, data in pairs}

    fixed = {("fixed", name, data) for name in variants for data in (own, more, most)}
    alone = {("alone", "most", "fast"), ("alone", "most", "fast --episodes=8")}  # no variant learns from the first
    assert validated("") == fixed | alone
    assert validated("fixed/most/seed_0") == {("fixed", "most", most)} and validated("alone") == alone
    assert validated("fixed/own/seed_1,fixed/more") == {one for one in fixed if most not in one and "most" not in one}


def test_demonstrations_of_policies_that_were_trained_elsewhere_are_not_made_again(tmp_path, monkeypatch):
    """Their rows are here and their checkpoints are not, as in a clone of results."""
    policy = {"type": "frozen_vit", "backbone": "dinov2_vits14"}
    variants = {"here": Variant(policy, seeds=1), "elsewhere": Variant(policy, seeds=1, data="--episodes=8")}
    here, elsewhere = runs = list_runs(study(variants=variants, references={}))
    store, asked = Store(tmp_path / "store"), []
    with store.claim([here.checkpoints]), store.writing(here.checkpoints) as folder:
        folder.mkdir()
    monkeypatch.setattr(Store, "get_all", lambda self, nodes, machine: asked.extend(nodes) or {})
    validate(runs, [], store, Machine(), tmp_path)
    assert {node.checkpoints for node in asked} == {here.checkpoints}
    assert [node.demonstrations for node in asked] == [here.arm.demonstrations.node]


def test_demonstrations_and_environment_have_one_action():
    with pytest.raises(InputError, match="settings.fixed: the actions of 'smoke --action=full' are .*`action: full`"):
        list_runs(study(settings={"fixed": Setting("smoke --action=full", ENV)}))
    many = Setting("smoke --task=bins,brick_to_bin_turned --action=full", ENV | {"action": "full"})
    assert {run.arm.env["action"] for run in list_runs(study(settings={"fixed": many}))} == {"full"}
    assert not any("action" in run.arm.env for run in list_runs(study()))


@pytest.mark.parametrize(
    ("language", "data", "env", "refused"),
    [
        ("minilm", "suite/orders", {"task": "brick_to_grey"}, None),
        ("minilm", "suite/orders", {"task": "brick_to_grey", "perturb": "language=3"}, None),
        ("minilm", "suite/orders", {"task": "brick_to_grey", "perturb": "wrong_task=1"}, None),
        ("minilm", "suite/orders", {"task": "brick_on_brick"}, get_task("brick_on_brick").instruction),
        ("minilm", "suite/orders --task=block_to_grey", {"task": "brick_to_grey"}, "brick"),
        ("minilm", "suite/orders --task=brick_to_grey", {"task": "brick_to_grey", "perturb": "wrong_task=1"}, "brick"),
        ("number", "suite/orders", {"task": "brick_to_grey"}, None),
        ("number", "suite/orders", {"task": "brick_to_grey", "perturb": "wrong_task=1"}, None),
        ("number", "suite/orders", {"task": "brick_to_grey", "perturb": "language=1"}, "it is told"),
        (None, "suite/orders", {"task": "brick_on_brick"}, None),
    ],
)
def test_an_instruction_that_nothing_was_trained_on_is_refused_before_anything_is_made(language, data, env, refused):
    told = {"policy": {"type": "frozen_vit", "backbone": "dinov2_vits14", "language": language}, "seeds": 1}
    many = study(settings={"one": Setting(data, ENV | env)}, variants={"told": Variant(**told)}, references={})
    said = rf"variants\.told\.policy: In settings\.one .*{refused}.* cannot learn from '{data}'"
    with pytest.raises(InputError, match=said) if refused else nullcontext():
        list_runs(many)


def test_seeds_with_demonstrations_of_their_own_have_no_attempt_in_common():
    policy = {"type": "frozen_vit", "backbone": "dinov2_vits14"}
    variants = {
        "a": Variant(policy, seeds=3),
        "clean": Variant(policy, seeds=3, data="--noise.sigma=0"),
        "driven": Variant(policy, seeds=3, dagger="smoke"),
    }
    shared = study(variants=variants, references={"replay": 2})
    own = study(variants=variants, references={"replay": 2}, demonstrations="own")
    assert changed(shared, own) == {run for run in digests(own) if not run.endswith("seed_0")}
    runs = {run.id: run for run in list_runs(own)}
    assert list(runs) == [run.id for run in list_runs(shared)], "in the same order, under the same names"
    for name in ("replay", "a", "clean"):
        starts = [run.arm.demonstrations.node.config.seed_start for run in runs.values() if run.arm.name == name]
        attempts = [set(range(start, start + SEEDS_APART)) for start in starts]
        assert len(set.union(*attempts)) == SEEDS_APART * len(starts)
    bases = [runs[f"fixed/a/seed_{seed}"].arm.demonstrations.node.config for seed in range(3)]
    driven = [run.plan for run in runs.values() if run.arm.name == "driven"]
    assert [plan.base.config.seed_start for plan in driven] == [base.seed_start for base in bases]
    assert len(set.union(*(set(plan.seeds(1)) for plan in driven))) == sum(len(plan.seeds(1)) for plan in driven)
    for seed in range(3):
        measured_on = [data for _, data in list_pairs([runs[f"fixed/a/seed_{seed}"]], [])]
        names = ["smoke", "smoke --noise.sigma=0", "smoke --labels=advice"]
        assert [(data.name, data.moved) for data in measured_on] == [(name, 0) for name in names]
    with pytest.raises(InputError, match="may take 2,002 attempts"):
        list_runs(study(settings={"fixed": Setting("smoke --episodes=1001", ENV)}, demonstrations="own"))
    often = {"driven": Variant(policy, seeds=3, dagger="smoke --rounds=3 --episodes=667")}
    list_runs(study(variants=often))
    with pytest.raises(InputError, match=r"variants\.driven\.dagger: .* not 2,001"):
        list_runs(study(variants=often, demonstrations="own"))


def test_seeds_of_a_draw_share_its_demonstrations_and_starts_and_no_other_draw_has_any_of_them():
    drawn = study(
        variants={"a": Variant(ACT, seeds=6)},
        references={"no_op": 2},
        demonstrations="own",
        starts="own",
        seeds_a_draw=2,
        eval_seed=300,
        episodes=5,
    )
    runs = [run for run in list_runs(drawn) if run.arm.name == "a"]
    assert [list(run.arm.starts) for run in runs] == [
        list(range(300 + 5 * (n // 2), 305 + 5 * (n // 2))) for n in range(6)
    ]
    assert [run.arm.demonstrations.moved for run in runs] == [SEEDS_APART * (n // 2) for n in range(6)]
    assert len({run.digest for run in runs}) == 6
    near = replace(drawn, settings={"fixed": Setting("smoke --seed_start=309", ENV)})
    with pytest.raises(InputError, match="evaluation 300 to 314"):
        list_runs(near)
    for fields in ({"starts": "own"}, {"seeds_a_draw": 2}):
        with pytest.raises(InputError, match="they need `demonstrations: own`"):
            study(**fields)
    with pytest.raises(InputError, match=r"variants\.a\.seeds must be a multiple of seeds_a_draw, 2"):
        replace(drawn, variants={"a": Variant(ACT, seeds=5)})


def test_a_run_depends_on_what_stands_in_its_plan_and_its_row_says_what_was_asked(tmp_path):
    """A file that is edited keeps its name."""
    file, digests = tmp_path / "wall.yaml", set()
    for joint in (0.010, 0.020):
        elements = {"a": {"kind": "brick", "at": [-0.4, -0.25]}, "b": {"kind": "brick", "beside": "a", "joint": joint}}
        file.write_text(written({"elements": elements}))
        settings = {"wall": Setting(f"smoke --task=plan:{file}", ENV | {"task": f"plan:{file}"})}
        runs = list_runs(study(settings=settings, variants={"a": Variant(ACT, seeds=1)}, references={"no_op": 1}))
        digests |= {run.digest for run in runs}
    assert len(digests) == 4, "of a policy and of a reference"
    Table(tmp_path, runs, Store(tmp_path / "store")).write()
    asked = {(row.task, row.instruction) for row in load_rows(tmp_path / ROWS)}
    assert asked == {(f"plan:{file}", "Build the wall after its plan.")}


def test_each_run_is_evaluated_from_its_own_draws_starts(tmp_path, monkeypatch):
    asked = []

    def rolled(agents, env, seeds, **how):
        asked.extend(list(one) for one in seeds)
        return iter(())

    monkeypatch.setattr(runs_module, "roll_out", rolled)
    drawn = study(references={"no_op": 3}, demonstrations="own", starts="own", eval_seed=300)
    runs = [run for run in list_runs(drawn) if run.arm.name == "no_op"]
    assert [*make_runs(Job(tuple(runs), Store(tmp_path), tmp_path))] == []
    assert asked == [[300, 301], [302, 303], [304, 305]]


@pytest.mark.parametrize(("demonstrations", "computations"), [("shared", 1), ("own", 3)])
def test_a_variants_seeds_are_evaluated_in_one_pass_and_trained_in_one_if_their_data_are_the_same(
    demonstrations, computations, tmp_path, monkeypatch
):
    policy = {"type": "frozen_vit", "backbone": "dinov2_vits14"}
    variants = {"a": Variant(policy, seeds=3), "driven": Variant(policy, seeds=3, dagger="smoke")}
    jobs = []
    monkeypatch.setattr("lerobot_constructskill.study.session.make_runs", lambda job: jobs.append(job) or job.runs)
    monkeypatch.setattr("lerobot_constructskill.study.session.validate", lambda *_: None)
    one = study(variants=variants, references={}, demonstrations=demonstrations)
    run_study(one, "", tmp_path / "x", Store(tmp_path / "store"), Options())
    together = [[run.id for run in job.runs] for job in jobs]
    assert together == [[f"fixed/{name}/seed_{seed}" for seed in range(3)] for name in variants]
    trained = [{run.checkpoints for run in job.runs} for job in jobs]
    assert [len(nodes) for nodes in trained] == [computations, 3], "each seed drives rounds of its own"
    assert {len(node.seeds) for node in trained[0]} == ({10} if computations == 1 else {1, 10})


def test_what_is_computed_together_does_not_depend_on_what_is_asked_for(tmp_path):
    """Ten seeds are one computation, of 3, of 10 or of 30, in one piece or in several."""
    vit = {"type": "frozen_vit", "backbone": "dinov2_vits14"}
    three, ten, thirty = (list_runs(study(variants={"a": Variant(vit, seeds=n)}, references={})) for n in (3, 10, 30))
    assert {run.checkpoints for run in three} == {run.checkpoints for run in ten} < {run.checkpoints for run in thirty}
    assert [list(node.seeds) for node in dict.fromkeys(run.checkpoints for run in thirty)] == [
        list(range(first, first + 10)) for first in (0, 10, 20)
    ]
    learning = list_runs(study(variants={"a": Variant(vit | {"readout": "attention"}, seeds=3)}, references={}))
    assert [list(run.checkpoints.seeds) for run in learning] == [[0], [1], [2]]


def test_names_labels_and_how_a_study_is_run_change_no_run():
    before = study()
    renamed = study(
        name="y", settings={"s": before.settings["fixed"]}, variants={"c": before.variants["a"]}, references={}
    )
    assert not changed(before, renamed)
    fields = {name: getattr(before, name) for name in ("name", "settings", "variants", "references", "episodes")}
    analysis = {"labels": {"a": "ACT"}, "order": ["b"], "comparisons": [["a", "b"]], "alpha": 0.01}
    other = StudyConfig(**fields, analysis=Analysis(**analysis), workers=7, together=3, store=Path("elsewhere"))
    assert other.study == before and not changed(before, other.study)
    elsewhere = {"device": "cpu", "push_to_hub": True, "tags": ["x"]}
    assert not changed(before, study(variants={"a": Variant(ACT | elsewhere, seeds=3)}))


@pytest.mark.parametrize(
    "fields",
    [
        {"episodes": 3},
        {"eval_seed": 7},
        {"settings": {"fixed": Setting("smoke", ENV | {"episode_length": 9})}},
        {"settings": {"fixed": Setting("smoke", ENV | {"perturb": "light=1"})}},
    ],
    ids=str,
)
def test_another_evaluation_is_another_run_of_the_same_checkpoint(fields):
    before, after = list_runs(study()), list_runs(study(**fields))
    assert not {run.digest for run in before} & {run.digest for run in after}
    for one, other in zip(before, after, strict=True):
        assert (one.checkpoints and one.checkpoints.digest) == (other.checkpoints and other.checkpoints.digest)


@pytest.mark.parametrize(
    "fields",
    [
        {"training": Training(epochs=7)},
        {"variants": {"a": Variant(ACT | {"dim_model": 128}, seeds=1)}},
        {"variants": {"a": Variant(ACT, seeds=1, training={"batch_size": 8})}},
        {"variants": {"a": Variant(ACT, seeds=1, data="fast")}},
    ],
    ids=str,
)
def test_another_policy_recipe_or_data_set_is_another_run(fields):
    assert "fixed/a/seed_0" in changed(study(), study(**fields))


def test_what_training_starts_from_is_told_by_its_weights(tmp_path):
    def begun(folder: str, weights: bytes) -> dict[str, str]:
        (tmp_path / folder).mkdir(exist_ok=True)
        (tmp_path / folder / "model.safetensors").write_bytes(weights)
        return digests(study(variants={"a": Variant(ACT | {"pretrained_path": str(tmp_path / folder)}, seeds=1)}))

    first = begun("base", b"one")
    assert begun("moved", b"one") == first != begun("base", b"another")
    (tmp_path / "moved" / "policy_preprocessor.json").write_text("{}")
    assert begun("moved", b"one") != first, "what it reads is prepared otherwise"


def test_an_edited_generator_file_runs_exactly_what_depends_on_it(tmp_path):
    paths = [tmp_path / "one.yaml", tmp_path / "two.yaml"]
    for path in paths:
        path.write_text("task: brick_to_bin\nepisodes: 2\n")
    settings = {path.stem: Setting(str(path), ENV) for path in paths}
    of = study(settings=settings, variants={"a": Variant(ACT, seeds=1)}, references={"no_op": 1, "replay": 1})
    before = digests(of)
    paths[0].write_text("task: brick_to_bin\nepisodes: 2\nnoise: {sigma: 0.02}\n# and a comment\n")
    after = digests(of)
    assert {name for name in after if after[name] != before[name]} == {"one/a/seed_0", "one/replay/seed_0"}


def test_a_moved_generator_file_runs_nothing(tmp_path):
    """Nor do defaults that are spelt out, or comments."""
    first, moved = tmp_path / "here.yaml", tmp_path / "there" / "moved.yaml"
    first.write_text("task: brick_to_bin\nepisodes: 2\n")
    moved.parent.mkdir()
    moved.write_text("# moved\nepisodes: 2\ntask: brick_to_bin\nnoise: {sigma: 0.01}\nlabels: clean\n")
    one, other = (study(settings={"fixed": Setting(str(path), ENV)}) for path in (first, moved))
    assert not changed(one, other)


def test_flags_over_a_set_are_the_set_that_a_file_with_these_fields_makes(tmp_path):
    file = tmp_path / "cut set.yaml"
    file.write_text("task: brick_to_bin\nepisodes: 7\nnoise: {sigma: 0.005, phases: [LIFT, CARRY]}\n")
    named = "fast_noise_free --episodes=7 --noise.sigma=0.005 '--noise.phases=[LIFT, CARRY]'"
    from_file, over_name = (study(variants={"a": Variant(ACT, 1, data=data)}) for data in (f"'{file}'", named))
    assert digests(from_file) == digests(over_name)


def test_a_variants_flags_go_over_the_set_of_each_setting():
    flags = "--noise.sigma=0 --episodes=3"
    settings = {name: Setting(name, ENV) for name in ("smoke", "fast")}
    spelt = {f"on_{name}": Variant(ACT, 1, data=f"{name} {flags}", settings=[name]) for name in settings}
    once = study(settings=settings, references={}, variants={"a": Variant(ACT, 1, data=flags)})
    both = study(settings=settings, references={}, variants=spelt)
    assert {*digests(once).values()} == {*digests(both).values()}
    assert list_runs(once)[0].arm.demonstrations.name == f"smoke {flags}"


def test_a_variants_recipe_goes_over_its_settings_and_that_over_the_studys():
    settings = {"few": Setting("smoke", ENV, training={"epochs": 96, "batch_size": 32}), "many": Setting("smoke", ENV)}
    variants = {"a": Variant(ACT, 1), "b": Variant(ACT, 1, training={"batch_size": 8})}
    of = study(settings=settings, variants=variants, references={}, training=Training(epochs=12))
    found = {run.id: (run.arm.training.epochs, run.arm.training.batch_size) for run in list_runs(of)}
    default = Training().batch_size
    assert found == {
        "few/a/seed_0": (96, 32),
        "few/b/seed_0": (96, 8),
        "many/a/seed_0": (12, default),
        "many/b/seed_0": (12, 8),
    }


def test_another_version_of_a_package_is_another_run(monkeypatch):
    from lerobot_constructskill.study import runs

    before = study()
    there = set(digests(before).values())
    real = runs.versions
    monkeypatch.setattr(runs, "versions", lambda *names: real(*names) | {"torch": "99.0"})
    assert not there & set(digests(before).values())


def test_two_studies_share_the_runs_that_they_share(tmp_path):
    first = make_all(study(), tmp_path)
    second = study(name="y", variants={"same": Variant(ACT, seeds=4)}, references={})
    table = Table(tmp_path / "y", list_runs(second), first.store)
    assert [run.id for run in table.missing()] == ["fixed/same/seed_3"]


def test_a_whole_study_runs_nothing_and_its_table_is_in_the_studys_order(tmp_path):
    of = study(
        settings={
            name: Setting("smoke", ENV | {"episode_length": length}) for name, length in (("second", 8), ("first", 9))
        }
    )
    table = make_all(of, tmp_path)  # nothing to run: neither data nor weights exist here
    rows = read_rows(tmp_path / "x" / "rows.parquet")
    found = [*zip(rows["setting"], rows["variant"], rows["training_seed"], strict=True)]
    assert found == [(run.arm.setting, run.arm.name, run.seed) for run in table.runs]
    assert {path.name for path in table.store.root.iterdir()} == {"runs", "locks"}


def test_whoever_has_the_folder_of_a_study_goes_on_with_it_without_its_runs(tmp_path):
    make_all(study(), tmp_path)
    published = read_rows(tmp_path / "x" / "rows.parquet")
    empty = Store(tmp_path / "elsewhere")
    more = study(variants=study().variants | {"b": Variant(ACT | {"dim_model": 64}, seeds=3), "c": Variant(ACT)})
    table = Table(tmp_path / "x", list_runs(more), empty)
    assert {run.id for run in table.missing()} == {"fixed/b/seed_2", *(f"fixed/c/seed_{seed}" for seed in range(10))}
    table.write()
    rows = read_rows(tmp_path / "x" / "rows.parquet")
    pd.testing.assert_frame_equal(rows[rows["error_kind"].isna()].reset_index(drop=True), published)
    other = list_runs(study(eval_seed=2000))  # the same names, and nothing of them was made
    assert len(Table(tmp_path / "x", other, empty).missing()) == len(other)
    run_study(study(), "", tmp_path / "x", empty, Options())  # nothing to run: neither data nor weights exist here
    pd.testing.assert_frame_equal(read_rows(tmp_path / "x" / "rows.parquet"), published)


def test_going_on_with_a_published_study_adds_to_its_provenance(tmp_path, monkeypatch):
    root, stage = tmp_path / "x", "of which evaluation, s"
    root.mkdir()
    (root / PROVENANCE).write_text(json.dumps({"wall time, s": 2000, stage: 700, "beside it": "tests"}))
    monkeypatch.setattr("lerobot_constructskill.study.session.make_runs", lambda job: job.runs)
    monkeypatch.setattr("lerobot_constructskill.study.session.validate", lambda *_: None)
    run_study(study(variants={"a": Variant(ACT, seeds=1)}, references={}), "", root, Store(tmp_path / "s"), Options())
    facts = json.loads((root / PROVENANCE).read_text())
    assert facts["wall time, s"] >= 2000 and facts[stage] == 700 and facts["beside it"] == "tests"
    (root / PROVENANCE).write_text('{"wall time, s": "1 h"}')
    with pytest.raises(InputError, match="wall time, s: Input should be a valid number"):
        run_study(study(), "", root, Store(tmp_path / "s"), Options())


def test_a_failed_run_stays_a_row_until_it_is_made_again(tmp_path):
    table = make_all(study(), tmp_path)
    row = {"evaluation_seed": 1000, "episode": 0, "error_kind": "weights", "error": "none here"}
    failed = [EpisodeRow(run=run.digest, training_seed=run.seed, **row) for run in table.runs[:1]]
    write_rows(failed, table.store.folder(table.runs[0]) / EPISODES, EpisodeRow)
    (tmp_path / "x" / "rows.parquet").unlink()
    Table(tmp_path / "x", table.runs, table.store).write()
    published = read_rows(tmp_path / "x" / "rows.parquet")
    assert set(published["error_kind"].dropna()) == {"weights"}
    elsewhere = Table(tmp_path / "x", table.runs, Store(tmp_path / "elsewhere"))
    assert elsewhere.missing() == table.runs[:1], "it is tried again"
    elsewhere.write()
    pd.testing.assert_frame_equal(read_rows(tmp_path / "x" / "rows.parquet"), published)
    fewer = study(variants={"b": study().variants["b"]})
    with pytest.raises(InputError, match=r"rows of 3 runs, such as fixed/a/seed_0.* would be lost"):
        run_study(fewer, "", tmp_path / "x", Store(tmp_path / "elsewhere"), Options())


def test_a_torn_line_of_times_is_left_out(tmp_path):
    with timed(tmp_path, "fixed/a", "evaluation", 1):
        pass
    with (tmp_path / TIMINGS).open("a") as file:
        file.write('{"arm": "fix{"arm": "fixed/b", "stage": "evaluation", "runs": 1, "seconds": 0.0}\n')
    with timed(tmp_path, "fixed/c", "evaluation", 1):
        pass
    assert [entry["arm"] for entry in entries(tmp_path)] == ["fixed/a", "fixed/c"]
    assert [(one.stage, one.runs) for one in time_by_stage(tmp_path)] == [("evaluation", 2)]


def test_the_time_of_a_stage_is_a_sum(tmp_path):
    lines = [("training", 10, 100), ("evaluation", 10, 50), ("training", 2, 30), ("demonstrations", 10, 1000)]
    told = ({"arm": "fixed/a", "stage": stage, "runs": runs, "seconds": took} for stage, runs, took in lines)
    (tmp_path / TIMINGS).write_text("".join(f"{json.dumps(line)}\n" for line in told))
    assert [(one.stage, one.runs, one.seconds) for one in time_by_stage(tmp_path)] == [
        ("demonstrations", 10, 1000),
        ("training", 12, 130),
        ("evaluation", 10, 50),
    ]


def test_a_study_goes_on_where_the_backbone_computes_in_another_precision(tmp_path, monkeypatch):
    policy = {"type": "frozen_vit", "backbone": "dinov2_vits14"}
    driven = Variant(policy, seeds=1, dagger="smoke")
    of = study(variants={"a": Variant(policy, seeds=2), "driven": driven}, references={"blind": 1, "no_op": 1})
    asked = study(variants={"a": Variant(policy | {"backbone_precision": "float32"}, seeds=2)}, references={})
    for here in PRECISIONS:
        monkeypatch.setattr(precision, "native_precision", lambda device="cpu", here=here: here)
        runs = {run.id: run.digests for run in list_runs(of)}
        assert {name: len(set(own)) for name, own in runs.items() if len(own) > 1} == {
            f"fixed/{name}": 2 for name in ("blind/seed_0", "a/seed_0", "a/seed_1", "driven/seed_0")
        }
        assert [len(run.digests) for run in list_runs(asked)] == [1, 1], "what is asked for is not left to the machine"
        if here == PRECISIONS[0]:
            make_all(of, tmp_path)
        table = Table(tmp_path / "x", list_runs(of), Store(tmp_path / "elsewhere"))
        assert not table.missing() and not table.lost()


def test_held_out_errors_outlive_the_checkpoint_that_they_are_of(tmp_path):
    table = make_all(study(), tmp_path)
    run = next(run for run in table.runs if run.checkpoints)
    with table.store.writing(run.checkpoints) as folder:
        folder.mkdir()
    error = heldout(run, run.arm.validated_on[0])
    with table.store.writing(error) as folder:
        folder.mkdir()
        (folder / FILE).write_text(json.dumps({"mse_m2": 1e-5}))
    Table(tmp_path / "x", table.runs, table.store).write()
    before = read_rows(tmp_path / "x" / "rows.parquet")
    assert set(before["heldout_mse_m2"].dropna()) == {1e-5}
    shutil.rmtree(table.store.folder(run.checkpoints))
    Table(tmp_path / "x", table.runs, table.store).write()
    pd.testing.assert_frame_equal(read_rows(tmp_path / "x" / "rows.parquet"), before)


def test_no_row_is_lost_that_is_nowhere_else(tmp_path):
    table = make_all(study(), tmp_path)
    fewer, empty = study(variants={"a": study().variants["a"]}), Store(tmp_path / "elsewhere")
    published = read_rows(tmp_path / "x" / "rows.parquet")
    with pytest.raises(InputError, match=r"rows of 2 runs, such as fixed/b/seed_0.* would be lost"):
        run_study(fewer, "another", tmp_path / "x", empty, Options())
    assert (tmp_path / "x" / "study.yaml").read_text() == ""
    pd.testing.assert_frame_equal(read_rows(tmp_path / "x" / "rows.parquet"), published)
    run_study(fewer, "", tmp_path / "x", table.store, Options())
    assert set(read_rows(tmp_path / "x" / "rows.parquet")["variant"]) == {"a", "no_op", "replay"}


def test_rows_of_other_code_are_replaced_an_arm_at_a_time(tmp_path):
    table = make_all(study(), tmp_path)
    published = tmp_path / "x" / ROWS
    older = [replace(row, run=None, final_error_m=0.5) for row in load_rows(published)]
    write_rows(older, published)
    mine = Store(tmp_path / "mine")
    with pytest.raises(InputError, match="would be lost. Give another --root, or --replace=true"):
        run_study(study(), "", tmp_path / "x", mine, Options(only="fixed/a/seed_1"))
    again = Table(tmp_path / "x", table.runs, mine, replaces=True)
    assert again.missing() == table.runs and not again.lost()
    again.write()
    assert load_rows(published) == older, "until something is made, they stand"
    run = next(run for run in table.runs if run.id == "fixed/a/seed_1")
    shutil.copytree(table.store.folder(run), mine.folder(run))
    Table(tmp_path / "x", table.runs, mine, replaces=True).write()
    left = {(row.variant, row.training_seed): row for row in load_rows(published)}
    assert left["a", 1].run == run.digest and {left["a", seed].error_kind for seed in (0, 2)} == {NOT_RUN}
    others = [row for row in left.values() if row.variant != "a"]
    assert others == [row for row in older if row.variant != "a"]
    fewer = study(variants={"a": study().variants["a"]})
    assert Table(tmp_path / "x", list_runs(fewer), mine, replaces=True).lost() == ["fixed/b/seed_0", "fixed/b/seed_1"]
    with pytest.raises(InputError, match="would be lost. Give another --root, or move the folder away"):
        run_study(fewer, "", tmp_path / "x", mine, Options(replace=True))


def test_a_failure_of_ours_takes_no_finished_row_out_of_a_published_table(tmp_path):
    table = make_all(study(), tmp_path)
    published = read_rows(tmp_path / "x" / "rows.parquet")
    run, mine = table.runs[0], Store(tmp_path / "mine")
    failed = replace(table.made(run)[0], error_kind="fault", error="RuntimeError: ours")
    with mine.writing(run) as folder:
        folder.mkdir()
        write_rows([failed], folder / EPISODES, EpisodeRow)
    Table(tmp_path / "x", table.runs, mine).write()
    pd.testing.assert_frame_equal(read_rows(tmp_path / "x" / "rows.parquet"), published)


def test_a_failed_row_is_not_in_the_way_of_whoever_can_make_it(tmp_path):
    table = make_all(study(), tmp_path)
    rows = load_rows(tmp_path / "x" / "rows.parquet", Row)
    other = [
        replace(row, run="0" * 16, error_kind="weights", error="no weights") for row in rows if row.variant == "b"
    ]
    write_rows([row for row in rows if row.variant != "b"] + other, tmp_path / "x" / "rows.parquet")
    again = Table(tmp_path / "x", table.runs, Store(tmp_path / "elsewhere"))
    assert not again.lost() and {run.arm.name for run in again.missing()} == {"b"}


def test_what_a_machine_lacks_for_one_job_leaves_the_others_alone(tmp_path, monkeypatch):
    def make(job):
        if job.runs[0].arm.name == "a":
            raise MachineError("out of memory")
        return job.runs

    monkeypatch.setattr(session, "make_runs", make)
    made = []
    with pytest.raises(MachineError, match="out of memory"):
        made.extend(session._execute(session._jobs(list_runs(study()), tmp_path, None, Options()), Options()))
    assert {run.arm.name for run in made} == {"no_op", "replay", "b"}


def test_what_a_job_elsewhere_made_before_it_stopped_is_kept(tmp_path, monkeypatch):
    def make(job):
        yield job.runs[0]
        raise MachineError("out of memory")

    monkeypatch.setattr(session, "make_runs", make)
    monkeypatch.setattr(session, "open_pool", lambda *_: pools.open_pool("processes", 1))  # in the place of Ray
    made, options = [], Options(executor="ray")
    with pytest.raises(MachineError, match="out of memory"):
        for run in session._execute(session._jobs(list_runs(study()), tmp_path, None, options), options):
            made.append(run.arm.name)
    assert sorted(made) == ["a", "b", "no_op", "replay"]


def test_what_is_missing_is_a_row_and_a_line_of_the_status(tmp_path):
    table = Table(tmp_path, list_runs(study()), Store(tmp_path / "store"))
    table.write()
    rows = read_rows(tmp_path / "rows.parquet")
    assert set(rows["error_kind"]) == {NOT_RUN} and len(rows) == 7 and set(rows["episodes"]) == {2}
    assert "fixed/a: 0 finished, 0 failed, 3 missing" in status(table, table.runs).splitlines()


THEIRS = "lerobot_policy_theirs"


@pytest.fixture
def edit(monkeypatch):
    """Make all of LeRobot's policies somebody's plugin, of the source that is named."""

    def to(source: str) -> None:
        monkeypatch.setattr("lerobot_constructskill.training.trainers.code_of", lambda *_: {THEIRS: source})

    to("source a")
    return to


def test_an_edited_plugin_is_told_and_its_runs_are_made_again_in_the_same_folder(tmp_path, edit, monkeypatch):
    table = make_all(study(), tmp_path)
    edit("source b")
    runs = list_runs(study())
    again = Table(tmp_path / "x", runs, table.store)
    said = status(again, runs).splitlines()
    assert f"fixed/a: 0 finished, 0 failed, 3 missing (3 made before with another {THEIRS})" in said
    assert {"fixed/no_op: 1 finished, 0 failed, 0 missing", "fixed/replay: 1 finished, 0 failed, 0 missing"} <= {*said}
    made = []
    monkeypatch.setattr(session, "make_runs", lambda job: made.extend(job.runs) or ())
    monkeypatch.setattr(session, "validate", lambda *_: None)
    run_study(study(), "", tmp_path / "x", table.store, Options())  # what would be lost is in the store
    assert [run.id for run in made] == [run.id for run in again.missing()]
    edit("source a")
    assert not Table(tmp_path / "x", list_runs(study()), table.store).missing(), "as it was, nothing is made"


def test_other_fields_of_a_study_are_told_by_their_places(tmp_path):
    table = make_all(study(), tmp_path)
    runs = list_runs(study(eval_seed=7))
    said = status(Table(tmp_path / "x", runs, table.store), runs)
    assert "fixed/b: 0 finished, 0 failed, 2 missing (2 made before with another evaluation.seed)" in said


def test_nothing_is_kept_of_code_that_was_edited_while_it_was_at_work(tmp_path, edit):
    run = list_runs(study())[-1]
    store, digest = Store(tmp_path), run.digest
    refused = pytest.raises(MachineError, match=rf"{THEIRS} is not what it was when this began: it was edited, or")
    with refused, store.writing(run.checkpoints) as folder:
        folder.mkdir()
        edit("source b")
    with refused:
        runs_module._write_failed(Job((run,), store, tmp_path), run, Failure.of(ValueError("half a line")))
    assert not store.has(run.checkpoints) and not store.has(run) and run.digest == digest


def test_the_status_tells_what_would_be_made_of_what_is_asked_and_how_long_it_takes(tmp_path):
    runs = list_runs(study())
    table = Table(tmp_path, runs, Store(tmp_path / "store"))
    took = {"demonstrations": 300, "data": 100, "training": 100, "evaluation": 400}
    lines = [{"arm": "fixed/a", "stage": stage, "runs": 2, "seconds": seconds} for stage, seconds in took.items()]
    (tmp_path / TIMINGS).write_text("".join(f"{json.dumps(line)}\n" for line in lines))
    lines = status(table, runs).splitlines()
    told = dict(zip(lines, lines[1:], strict=False))
    assert told["fixed/a: 0 finished, 0 failed, 3 missing"] == "    to make: seeds 0, 1, 2, about 12 min"
    assert told["fixed/b: 0 finished, 0 failed, 2 missing"] == "    to make: seeds 0, 1, time unknown"
    assert lines[-1] == "To make: 7 runs, about 18 min and some of unknown time; first the demonstrations: smoke"
    assert status(table, choose(runs, "fixed/a/seed_1")).splitlines() == [
        "fixed/a: 0 finished, 0 failed, 1 missing",
        "    to make: seed 1, about 9 min",  # 300 + 50 + 200 s
        "To make: 1 run, about 9 min; first the demonstrations: smoke",
    ]


def test_the_status_of_a_misspelt_part_is_refused(tmp_path):
    fields = {name: getattr(study(), name) for name in ("name", "settings", "variants", "references", "episodes")}
    asked = StudyConfig(**fields, root=tmp_path, store=tmp_path / "store", status=True, only="fixed/aa")
    with pytest.raises(InputError, match="--only=fixed/aa matches no run"):
        study_command(asked)


def test_runs_that_are_something_else_are_one_sentence(tmp_path):
    table = make_all(study(), tmp_path)
    folder = table.store.folder(table.runs[-1])
    (tmp_path / "x" / ROWS).unlink()
    (folder / EPISODES).unlink()
    with pytest.raises(InputError, match="has no episodes"):
        make_all(study(), tmp_path)
    (folder / EPISODES).write_text("no parquet")
    with pytest.raises(InputError, match="cannot be read"):
        make_all(study(), tmp_path)
    (folder / "spec.json").unlink()
    with pytest.raises(InputError, match="move it away"):
        make_all(study(), tmp_path)


def test_some_runs_are_chosen_by_their_names():
    runs = list_runs(study())
    assert [run.id for run in choose(runs, "*/seed_1, fixed/no_op")] == [
        "fixed/no_op/seed_0",
        "fixed/a/seed_1",
        "fixed/b/seed_1",
    ]
    assert len(choose(runs, "")) == len(choose(runs, "fixed")) == len(runs)
    assert len(choose(list_runs(study(variants={"a": Variant(ACT, 12)})), "fixed/a/seed_1")) == 1
    with pytest.raises(InputError, match="matches no run"):
        choose(runs, "other/*")
    with pytest.raises(InputError, match="fixd/a matches no run"):
        choose(runs, "fixed/no_op, fixd/a")


def test_a_reference_of_a_policy_is_made_of_the_first_variant_that_can_be_it(tmp_path, tiny_weights):
    tiny = {"type": "frozen_vit", "backbone": "vit_tiny16", "backbone_path": str(tiny_weights)}
    of = study(
        variants={"act": Variant(ACT, 1), "tiny": Variant(tiny, 1, training={"epochs": 2})},
        references={"blind": 1, "untrained": 1},
    )
    blind, untrained, _, seeing = list_runs(of)
    assert blind.arm.learner.config == replace(seeing.arm.learner.config, blind=True)
    assert blind.arm.training == untrained.arm.training == Training(epochs=2)
    assert not untrained.arm.learner.config.backbone_pretrained and seeing.arm.learner.config.backbone_pretrained
    with pytest.raises(InputError, match="'blind' needs a variant whose policy has blind"):
        list_runs(study(references={"blind": 1}))
    two = {"fixed": Setting("smoke", ENV), "pixels": Setting("smoke", {"episode_length": 8})}
    own = {
        "stateful": Variant(tiny | {"use_state": True}, 1, settings=["fixed"]),
        "noisy": Variant(tiny, 1, data="--noise.sigma=0.02", settings=["pixels"]),
    }
    stateful, _, noisy, shown = list_runs(study(settings=two, variants=own, references={"blind": 1}))
    assert stateful.arm.learner.config.use_state and not noisy.arm.learner.config.use_state
    assert noisy.arm.demonstrations == shown.arm.demonstrations, "it differs in its eyes alone"


@pytest.mark.parametrize(
    "fields, said",
    [
        ({"variants": {}}, "at least one of variants"),
        ({"variants": {"a b": Variant(ACT)}}, "'a b' cannot name"),
        ({"variants": {"no_op": Variant(ACT)}}, "name of two things"),
        (
            {
                "settings": {"fixed": Setting("smoke", ENV), "fixed-a": Setting("smoke", ENV)},
                "variants": {"a-b": Variant(ACT), "b": Variant(ACT)},
            },
            "both 'fixed-a-b' when joined",
        ),
        ({"variants": {"a": Variant({})}}, "must name its policy's type"),
        ({"variants": {"a": Variant(ACT, settings=[])}}, "in one setting or more"),
        (
            {
                "settings": {"fixed": Setting("smoke", ENV), "bare": Setting("smoke", ENV)},
                "variants": {"a": Variant(ACT, settings=["fixed"])},
            },
            "No variant runs in the setting 'bare'",
        ),
        ({"variants": {"a": Variant(ACT, training={"holdout": 4})}}, "hold out the same"),
        (
            {"variants": {"a": Variant({"type": "frozen_vit", "pretrained_path": "somewhere"})}},
            "variants.a.policy: .*heads from the start",
        ),
        ({"variants": {"a": Variant({"type": "pi9"})}}, "variants.a.policy: .*pi9"),
        (
            {
                "settings": {"fixed": Setting("fast_wrist --cameras=[wrist]", ENV)},
                "variants": {"a": Variant({"type": "frozen_vit", "backbone": "dinov2_vits14"})},
            },
            "variants.a.policy: The policy reads camera 'base'; the demonstrations are recorded by wrist",
        ),
        ({"variants": {"a": Variant(ACT | {"chunk_sise": 5})}}, "variants.a.policy: .*chunk_sise"),
        (
            {"variants": {"a": Variant(ACT | {"chunk_size": 5})}},
            "variants.a.policy: The chunk size is",
        ),
        ({"variants": {"a": Variant({"type": "frozen_vit", "chunk_size": 0})}}, "variants.a.policy: chunk_size"),
        ({"variants": {"a": Variant(ACT, training={"epoch": 5})}}, "variants.a.training: .*epoch"),
        (
            {"variants": {"a": Variant(ACT, training={"epochs": -2})}},
            "variants.a.training: .*epochs must be a whole number from 1",
        ),
        ({"variants": {"a": Variant(ACT, settings=["moved"])}}, "Unknown setting 'moved' of variant 'a'"),
        ({"variants": {"a": Variant(ACT, data="fast --episode=7")}}, "fixed, data fast --episode=7: .*--episode=7"),
        ({"variants": {"a": Variant(ACT, data="fast 'x")}}, "data fast 'x: No closing quotation"),
        ({"settings": {"fixed": Setting("", {})}}, "settings.fixed.data must be one line of text, not ''"),
        ({"variants": {"a": Variant(ACT, data="")}}, "variants.a.data must be one line of text, not ''"),
        ({"variants": {"a": Variant(ACT, dagger="")}}, "variants.a.dagger must be one line of text, not ''"),
        ({"variants": {"a": Variant(ACT, seeds=100_000)}}, "seeds must be a whole number from 1 to 1000, not 100000"),
        ({"settings": {"fixed": Setting("smoke", {"type": "pusht"})}}, "fixed.env: type must be constructskill, not"),
        ({"variants": {"a": Variant(ACT, dagger="smoke --round=2")}}, "dagger smoke --round=2: .*--round=2"),
        ({"variants": {"a": Variant(ACT, data="fasst")}}, "no file and no generate configuration 'fasst'"),
        ({"references": {"oracle": 1}}, "Unknown reference 'oracle'; the references are: no_op"),
        ({"references": {"random": 0}}, "references.random: seeds must be a whole number from 1"),
        ({"episodes": 0}, "episodes must be a whole number from 1"),
        ({"eval_seed": -1}, "eval_seed must be a whole number from 0"),
        ({"eval_seed": 999_999}, "demonstrations 'smoke' may have starts 1000000 .* no start may be in both"),
        (
            {"variants": {"a": Variant({"type": "frozen_vit"}, dagger="smoke")}, "eval_seed": 2_000_000},
            "variants.a: The evaluation may have starts 2000000 .* and the rounds 2000000",
        ),
        ({"settings": {"fixed": Setting("smoke", {"episode_length": 8})}}, "variants.a.policy: .*obs_type"),
        ({"settings": {"fixed": Setting("smoke", {"task": "brick"})}}, "settings.fixed.env: Unknown task 'brick'"),
        ({"settings": {"fixed": Setting("smoke", ENV, training={"epoch": 5})}}, "settings.fixed.training: .*epoch"),
        ({"settings": {"fixed": Setting("smoke", {"foo": 1})}}, "settings.fixed.env: .*foo"),
        ({"settings": {"fixed": Setting("smoke", {"episode_length": -5})}}, "settings.fixed.env: episode_length"),
        ({"settings": {"fixed": Setting("smoke", {"task": "bins"})}}, "settings.fixed.env: .*bins"),
        (
            {"settings": {"fixed": Setting("smoke", ENV | {"task": "bins"})}},
            "settings.fixed.env: 'bins' is a suite, and one task is asked for",
        ),
        ({"settings": {"fixed": Setting("smoke", ENV | {"task": "block_to_bin", "perturb": "size=1"})}}, "no brick"),
        (
            {
                "settings": {"fixed": Setting("smoke", {"obs_type": "pixels"})},
                "variants": {"a": Variant({"type": "frozen_vit", "camera": "wrist"})},
            },
            "variants.a.policy: The policy reads camera 'wrist'",
        ),
    ],
    ids=str,
)
def test_a_study_that_cannot_be_run_is_refused_in_one_sentence_before_anything_runs(fields, said):
    with pytest.raises(UserError, match=said) as refused:
        list_runs(study(**fields))
    assert "\n" not in str(refused.value)


@pytest.mark.parametrize("recipe", [{"epochs": -2}, {"batch_size": 0}, {"holdout": 1}], ids=str)
def test_a_recipe_that_trains_nothing_is_refused(recipe):
    with pytest.raises(InputError, match=f"training.{next(iter(recipe))} must be a whole number from"):
        Training(**recipe)


@pytest.mark.parametrize("how", [{"executor": "slurm"}, {"together": 0}, {"workers": 0}], ids=str)
def test_a_way_to_run_that_there_is_not_is_refused(how):
    with pytest.raises(InputError, match=next(iter(how))):
        Options(**how)


@pytest.mark.parametrize("env", [{"plan": "course_of_three"}, {"task": "plan:course_of_three"}, {}], ids=str)
def test_a_study_names_the_task_of_each_setting_whatever_its_file_says(env, tmp_path):
    kept = {"obs_type": "pixels_agent_pos", "render_backend": "auto"}
    given = study(settings={"fixed": Setting("smoke", env | kept | {"fps": 20})})
    fields = {name: getattr(given, name) for name in ("name", "settings", "variants", "references")}
    (tmp_path / STUDY).write_text(text_of(StudyConfig(**fields)))
    task = resolve_env(env)["task"]
    assert read_environments(tmp_path) == {"fixed": {"task": task} | kept}, "and nothing that a machine chose"
    assert not changed(given, study(settings={"fixed": Setting("smoke", read_environments(tmp_path)["fixed"])}))


def test_a_cut_study_is_made_of_the_same_runs():
    whole = StudyConfig(**{name: getattr(study(), name) for name in ("name", "settings", "variants", "references")})
    cut = replace(whole, seeds=2).study
    assert {name: variant.seeds for name, variant in cut.variants.items()} == {"a": 2, "b": 2}
    assert not changed(whole.study, cut)


def _wrapped(cause: Exception) -> Exception:
    try:
        raise ValueError("An error occurred while generating the dataset") from cause
    except ValueError as error:
        return error


@pytest.mark.parametrize(
    ("error", "is_the_machines"),
    [
        (_wrapped(OSError(ENOSPC, "No space left on device")), True),
        (OSError(ESTALE, "Stale file handle"), True),
        (
            RuntimeError("DefaultCPUAllocator: can't allocate memory: you tried to allocate 8 bytes"),
            True,
        ),
        (torch.OutOfMemoryError("CUDA out of memory. Tried to allocate 2 GiB"), True),
        (RuntimeError("vk::Device::allocateMemory: ErrorOutOfDeviceMemory"), True),
        (RuntimeError("Found no NVIDIA driver on your system."), True),
        (_wrapped(httpx.ConnectTimeout("timed out")), True),
        (RuntimeError("shape mismatch"), False),
        (_wrapped(FileNotFoundError(ENOENT, "no weights")), False),
    ],
    ids=str,
)
def test_what_the_machine_lacks_is_no_result_of_a_run_until_it_comes_back_each_time(
    error, is_the_machines, tmp_path, monkeypatch
):
    job = Job(tuple(list_runs(study())[2:4]), Store(tmp_path), tmp_path)  # of a policy
    lacking, other = job.runs
    monkeypatch.setattr(Store, "get_all", lambda *_: {lacking.checkpoints: Failure.of(error)})
    monkeypatch.setattr(runs_module, "_agent", lambda *_: {}["agent"])
    made = []
    for _ in range(runs_module.TRIES - 1 if is_the_machines else 0):
        with pytest.raises(MachineError) as raised:
            for run in make_runs(job):
                made.append(run)
        assert {*made} == {other}, "the others are made"
        assert " ".join(str(error).split()) in str(raised.value)
        made = []
    assert {*make_runs(job)} == {lacking, other}
    (row,) = load_rows(job.store.folder(lacking) / EPISODES, EpisodeRow)
    assert row.error_kind == ("machine" if is_the_machines else kind_of(error)) and str(error) in row.error
    log = (job.store.folder(lacking) / LOG).read_text()
    assert log.count(str(error)) >= (runs_module.TRIES if is_the_machines else 1)


def test_a_card_that_fails_is_a_row_that_does_not_name_it(tmp_path, monkeypatch):
    def fails(_):
        raise RuntimeError("Found no NVIDIA driver on your system.")

    monkeypatch.setattr(torch.cuda, "get_device_name", fails)
    (run,) = list_runs(study(references={}, variants={"a": Variant(ACT, seeds=1)}))
    run.arm.learner.config.device = "cuda"
    monkeypatch.setattr(Store, "get_all", lambda *_: {run.checkpoints: Failure.of(RuntimeError("CUDA error"))})
    job = Job((run,), Store(tmp_path), tmp_path)
    for _ in range(runs_module.TRIES - 1):
        with pytest.raises(MachineError, match="CUDA error"):
            [*make_runs(job)]
    assert [*make_runs(job)] == [run]


def test_the_machines_failure_of_one_seed_leaves_the_rollouts_of_the_others(tmp_path, monkeypatch):
    job = Job(tuple(list_runs(study())[2:4]), Store(tmp_path), tmp_path)
    rollouts = [SimpleNamespace(error=MachineError("lost")), SimpleNamespace(error=None)]
    monkeypatch.setattr(Store, "get_all", lambda *_: {})
    monkeypatch.setattr(runs_module, "_agent", lambda *_: "agent")
    monkeypatch.setattr(runs_module, "roll_out", lambda *_, **__: enumerate(rollouts))
    written = []
    monkeypatch.setattr(runs_module, "_write_finished", lambda job, run, *_: written.append(run))
    with pytest.raises(MachineError, match="^lost$"):
        [*make_runs(job)]
    assert written == [job.runs[1]]


@pytest.mark.parametrize(
    ("device", "backend", "card"),
    [
        ("cpu", "physx_cpu, sapien_cpu rendering", None),
        (None, None, None),
        ("cuda:1", "physx_cpu, sapien_cpu rendering", "card cuda:1"),
        ("cuda:1", None, None),
        ("cpu", "physx_cpu, sapien_cuda rendering", "card None"),
    ],
)
def test_a_row_names_the_graphics_card_where_it_used_one(device, backend, card, monkeypatch):
    monkeypatch.setattr(torch.cuda, "get_device_name", lambda which: f"card {which}")
    learner = device and SimpleNamespace(config=SimpleNamespace(device=device))
    run = SimpleNamespace(arm=SimpleNamespace(learner=learner))
    assert runs_module._made_on(run, backend) == {"processor": processor()} | ({"card": card} if card else {})


EDITS = {
    "contract.py": ("everything", "HELD_OUT_EVERY = 8", "HELD_OUT_EVERY = 7"),
    "sim/tasks/brick.py": ("everything", "CLAY_DENSITY = 1000.0", "CLAY_DENSITY = 1100.0"),
    "envs/actions.py": ("everything", "import numpy as np\n", "import numpy as np\n\nTIMES = 0.9\n"),
    "demos/expert.py": ("demonstrations", "    gain: Gain = 1.0", "    gain: Gain = 1.1"),
    "training/recipe.py": ("training", "epochs: Count = 150", "epochs: Count = 151"),
    "policies/frozen_vit/readouts.py": ("policy", "POINT_SCALE = 8.0", "POINT_SCALE = 9.0"),
    "features/encode.py": ("policy", "import numpy as np\n", "import numpy as np\n\nBATCHES = 2\n"),
    "rollout/lockstep.py": ("episodes", "from dataclasses import", "TIMES = 0.9\nfrom dataclasses import"),
    "study/runs.py": ("runs", "FILMED_SEED = 0", "FILMED_SEED = 1"),
    "dagger/driving.py": ("nothing", "from dataclasses import", "TIMES = 0.9\nfrom dataclasses import"),
    "study/table.py": ("nothing", "class Table", "class Rows"),
    "analysis/report/formats.py": ("nothing", '"""', '"""Said otherwise. '),
}
VIT = {"type": "frozen_vit", "backbone": "dinov2_vits14"}


def everything_of(study: Study) -> dict[str, str]:
    """Digests of all that a study makes, by what it is."""
    found = {}
    for run in list_runs(study):
        found[f"runs/{run.arm.name}"] = run.digest
        if run.arm.demonstrations:
            found["demonstrations"] = run.arm.demonstrations.node.digest
        if run.checkpoints:
            found[f"checkpoints/{run.arm.name}"] = run.checkpoints.digest
            found[f"heldout/{run.arm.name}"] = heldout(run, run.arm.demonstrations).digest
            data = run.checkpoints.inputs["data"]
            found |= {f"features/{run.arm.name}": data.digest} if data.kind == "features" else {}
    return found


@pytest.fixture(scope="module")
def copied(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("copied") / "lerobot_constructskill"
    return shutil.copytree(revisions.PACKAGE, folder, ignore=shutil.ignore_patterns("__pycache__"))


@pytest.mark.parametrize("file", EDITS)
def test_an_edited_line_of_ours_makes_exactly_what_depends_on_it_stale(file, copied, tmp_path, monkeypatch):
    """As digests tell it: the edit is in a copy of the package, of which the revisions are."""
    variants = {"a": Variant(ACT, seeds=1), "vit": Variant(VIT, seeds=1)}
    of = study(variants=variants, references={"no_op": 1, "replay": 1, "expert": 1})
    table, before = make_all(of, tmp_path), everything_of(of)
    trained = {f"{kind}/{name}" for kind in ("runs", "checkpoints", "heldout") for name in variants}
    stale = {
        "everything": {*before},
        "demonstrations": {"demonstrations", "features/vit", *trained, "runs/replay", "runs/expert"},
        "training": trained,
        "policy": {"runs/vit", "checkpoints/vit", "heldout/vit", "features/vit"},
        "episodes": {name for name in before if name.startswith(("runs", "heldout"))},
        "runs": {name for name in before if name.startswith("runs")},
        "nothing": set(),
    }
    what, old, new = EDITS[file]
    text = (copied / file).read_text()
    assert old in text
    monkeypatch.setattr(revisions, "PACKAGE", copied)
    monkeypatch.setattr(revisions, "LOOKED_AT_S", 1e-9)
    (copied / file).write_text(text.replace(old, new, 1))
    try:
        now = everything_of(of)
        assert {name for name in before if now[name] != before[name]} == stale[what]
        runs = list_runs(of)
        said = status(Table(tmp_path / "x", runs, table.store), runs)
        assert ("made before with another constructskill." in said) == (f"({file})" in said) == (what != "nothing")
    finally:
        (copied / file).write_text(text)


def test_rows_of_before_there_were_revisions_say_so(tmp_path):
    table = make_all(study(), tmp_path)
    told = json.dumps({"constructskill": BEFORE})
    rows = [replace(row, run=f"of {row.training_seed}", versions=told) for row in load_rows(table.root / ROWS)]
    write_rows(rows, tmp_path / "published" / ROWS)
    runs = list_runs(study())
    said = status(Table(tmp_path / "published", runs, Store(tmp_path / "empty")), runs)
    assert "fixed/a: 0 finished, 0 failed, 3 missing (3 made before with another code, before revisions)" in said
