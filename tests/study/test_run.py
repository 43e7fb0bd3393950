"""A study as a user runs it: killed at several stages it ends as the undisturbed one, and failures are rows."""

import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pandas as pd
import pytest
import yaml

from lerobot_constructskill.scripts.study import StudyConfig
from lerobot_constructskill.study import checkpoints
from lerobot_constructskill.study.checkpoints import HELDOUT_FILE
from lerobot_constructskill.study.plan import Setting, StudyPlan, Variant
from lerobot_constructskill.study.prepare import Store
from lerobot_constructskill.study.rows import SCHEMA, Row, merge_rows, read_rows, write_rows
from lerobot_constructskill.study.run import Options, run_study

REPOSITORY = Path(__file__).parents[2]

STAGES = ("data/*.partial/shards/*/*/episode", f"study/runs/fixed/tiny/*/{HELDOUT_FILE}", "study/results/*/tiny/*")
"""Files whose appearance gets a study killed: a demonstration, a checkpoint, a run's rows."""

ACT = {"type": "act", "pretrained_backbone_weights": None, "dim_model": 32, "n_heads": 2, "dim_feedforward": 32}
"""A policy that lerobot-train trains."""


@pytest.fixture(scope="module")
def plan_file(tmp_path_factory, tiny_weights):
    """Two seeds of a tiny policy, one that cannot be had, and every reference but the costly ones."""
    tiny = {"type": "frozen_vit", "backbone": "vit_tiny16", "backbone_path": str(tiny_weights)}
    plan = {
        "name": "tiny",
        "settings": {
            "fixed": {
                "data": str(REPOSITORY / "configs/generate/smoke.yaml"),
                "env": {"task": "brick_to_bin", "episode_length": 8, "obs_type": "pixels_agent_pos"},
            }
        },
        "variants": {
            "tiny": {"policy": tiny, "seeds": 2},
            "act": {"policy": ACT | {"use_vae": False}, "seeds": 1},
            "absent": {"policy": tiny | {"backbone_path": "/no/such/weights"}, "seeds": 2},
        },
        "references": {"no_op": 1, "random": 2, "replay": 1, "blind": 1, "expert": 1},
        "training": {"epochs": 1, "batch_size": 64, "holdout": 2},
        "episodes": 2,
    }
    file = tmp_path_factory.mktemp("plan") / "tiny.yaml"
    file.write_text(yaml.safe_dump(plan, sort_keys=False))
    return file


def start(plan_file, root, data_root, *options, **variables):
    command = [sys.executable, "-m", "lerobot_constructskill.scripts.study", f"--config_path={plan_file}"]
    flags = [f"--root={root}", f"--data_root={data_root}", "--workers=1"]
    quiet = os.environ | {"HF_HUB_OFFLINE": "1"} | variables
    log = root.with_suffix(".log").open("a")
    return subprocess.Popen([*command, *flags, *options], env=quiet, stdout=log, stderr=log, start_new_session=True)


def finish(plan_file, root, data_root):
    assert start(plan_file, root, data_root).wait(timeout=600) == 0, root.with_suffix(".log").read_text()[-2000:]
    return read_rows(root / "rows.parquet")


@pytest.fixture(scope="module")
def undisturbed(plan_file, tmp_path_factory):
    folder = tmp_path_factory.mktemp("undisturbed")
    return finish(plan_file, folder / "study", folder / "data")


@pytest.mark.sim
@pytest.mark.slow
def test_killed_at_any_stage_it_ends_as_the_undisturbed_one(plan_file, undisturbed, tmp_path):
    root, data = tmp_path / "study", tmp_path / "data"
    for stage in STAGES:
        process = start(plan_file, root, data)
        while process.poll() is None and not list(tmp_path.glob(stage)):
            time.sleep(0.02)
        os.killpg(process.pid, signal.SIGKILL)
        process.wait()
    pd.testing.assert_frame_equal(finish(plan_file, root, data), undisturbed)


@pytest.mark.sim
@pytest.mark.slow
def test_the_rows_say_what_happened(undisturbed):
    finished = undisturbed[undisturbed["error"].isna()]
    assert set(undisturbed["variant"]) - set(finished["variant"]) == {"absent"}, list(undisturbed["error"].dropna())
    counts = finished.groupby("variant").size().to_dict()
    assert counts == {"tiny": 4, "act": 2, "no_op": 2, "random": 4, "replay": 2, "blind": 2, "expert": 2}
    assert set(finished["steps"]) == {8} and set(finished["evaluation_seed"]) == {1000, 1001}
    assert finished["backend"].str.startswith("physx_cpu").all() and finished["final_error_m"].between(0.1, 1).all()
    tiny = finished[finished["variant"] == "tiny"]
    assert tiny["heldout_mse_m2"].between(0, 0.01).all() and tiny["weights_sha256"].nunique() == 2
    for row in tiny.itertuples():
        assert list(json.loads(row.heldout_mse_m2_by_data).values()) == [row.heldout_mse_m2]
    failed = undisturbed[undisturbed["error"].notna()]
    assert list(failed["variant"]) == ["absent"] * 2 and failed["lifted"].isna().all()
    assert failed["error"].str.contains("/no/such/weights").all()
    assert undisturbed["dataset_sha256"].nunique() == 1 and undisturbed["plan_sha256"].nunique() == 1


@pytest.mark.sim
@pytest.mark.slow
def test_on_a_cluster_it_ends_as_the_undisturbed_one_though_a_machine_dies(plan_file, undisturbed, tmp_path):
    pytest.importorskip("ray", reason="the extra `distributed` brings it")
    from ray.cluster_utils import Cluster

    cluster = Cluster(initialize_head=True, head_node_args={"num_cpus": 0, "include_dashboard": False})
    try:
        _, mortal = (cluster.add_node(num_cpus=1) for _ in range(2))
        ray = ["--executor=ray", "--together=1"]
        process = start(plan_file, tmp_path / "study", tmp_path / "data", *ray, RAY_ADDRESS=cluster.address)
        while process.poll() is None and not list(tmp_path.glob(STAGES[1])):
            time.sleep(0.02)
        cluster.remove_node(mortal, allow_graceful=False)
        assert process.wait(timeout=600) == 0, (tmp_path / "study.log").read_text()[-2000:]
    finally:
        cluster.shutdown()
    pd.testing.assert_frame_equal(read_rows(tmp_path / "study" / "rows.parquet"), undisturbed)


def plan(**fields):
    variants = {"a": Variant({"type": "frozen_vit"}, seeds=2)}
    return StudyPlan(**{"name": "x", "settings": {"fixed": Setting("d.yaml")}, "variants": variants} | fields)


def test_a_changed_plan_is_not_mixed_with_old_results(tmp_path):
    for number, changed in enumerate((plan(episodes=3), plan(eval_seed=7), plan(alpha=0.1))):
        root = tmp_path / str(number)
        run_study_without_runs(plan(), root)
        with pytest.raises(ValueError, match="another plan"):
            run_study_without_runs(changed, root)


def run_study_without_runs(of, root):
    """Every run is there already, as a row; the last was written first."""
    root.mkdir(exist_ok=True)
    for run in reversed(of.runs):
        row = Row(of.sha256, run.setting, run.variant, False, run.seed, 1000, 0)
        write_rows([row], root / "results" / run.id / "rows.parquet")
    return run_study(of, root, Store(root / "data"), Options())


def test_finished_runs_are_kept_in_the_order_of_the_plan(tmp_path):
    variants = {name: Variant({"type": "frozen_vit"}, seeds=11) for name in ("b", "a")}
    settings = {name: Setting("d.yaml") for name in ("second", "first")}
    of = plan(variants=variants, settings=settings)
    rows = run_study_without_runs(of, tmp_path / "study")  # nothing to run: neither data nor weights exist here
    assert [*zip(rows["setting"], rows["variant"], rows["training_seed"], strict=True)] == [
        (run.setting, run.variant, run.seed) for run in of.runs
    ]
    assert not (tmp_path / "study" / "data").exists()


def test_a_seed_that_cannot_be_trained_takes_no_other_with_it(tmp_path, monkeypatch):
    """lerobot-train is replaced: there is no way to make it fail on one seed alone."""

    def train_stock(job, run, *_):
        if run.seed == 1:
            raise RuntimeError("out of memory")

    monkeypatch.setattr(checkpoints, "_train_stock", train_stock)
    monkeypatch.setattr(checkpoints, "demonstrations", lambda job: None)
    of = plan(variants={"act": Variant({"type": "act"}, seeds=3)})
    failed = checkpoints.train(checkpoints.Job(of, tuple(of.runs), tmp_path, Store(tmp_path / "data")))
    assert {run.seed: str(error) for run, error in failed.items()} == {1: "out of memory"}


@pytest.mark.parametrize(
    "fields, said",
    [
        ({"variants": {}}, "at least one of variants"),
        ({"variants": {"a b": Variant({"type": "act"})}}, "'a b' is no name"),
        ({"variants": {"expert": Variant({"type": "act"})}}, "name of a reference"),
        ({"variants": {"a": Variant({})}}, "must name its policy's type"),
        ({"references": {"oracle": 1}}, "Unknown reference 'oracle'"),
        ({"references": {"random": 0}}, "random must be at least 1"),
        ({"episodes": 0}, "episodes must be at least 1"),
        ({"comparisons": [["a", "b"]]}, "Unknown variant in comparisons 'b'"),
        ({"settings": {"fixed": Setting("d.yaml", {"task": "brick"})}}, "Unknown task 'brick'"),
    ],
)
def test_a_plan_that_cannot_be_run_is_refused_in_one_sentence(fields, said):
    with pytest.raises(ValueError, match=said) as refused:
        plan(**fields)
    assert "\n" not in str(refused.value)


def test_how_a_study_is_run_is_no_part_of_its_plan():
    fields = {"name": "x", "settings": {"fixed": Setting("d.yaml")}, "variants": {"a": Variant({"type": "act"}, 9)}}
    one = StudyConfig(**fields, workers=1, together=3)
    assert one.plan.sha256 == StudyConfig(**fields).plan.sha256
    assert StudyConfig(**fields, seeds=4).plan.sha256 != one.plan.sha256
    assert StudyConfig(**fields, seeds=4).plan.variants["a"].seeds == 4


def test_rows_of_another_version_are_refused(tmp_path):
    write_rows([Row("p", "s", "v", False, 0, 1000, 0, lifted=True)], tmp_path / "a.parquet")
    merge_rows([tmp_path / "a.parquet"] * 2, tmp_path / "both.parquet")
    assert list(read_rows(tmp_path / "both.parquet").columns) == SCHEMA.names and len(read_rows()) == 0
    pd.DataFrame({"x": [1]}).to_parquet(tmp_path / "b.parquet")
    with pytest.raises(ValueError, match="not a table of study rows"):
        read_rows(tmp_path / "a.parquet", tmp_path / "b.parquet")
