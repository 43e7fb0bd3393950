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
from commands import OFFLINE, call

from lerobot_constructskill.artifacts.locks import locked
from lerobot_constructskill.artifacts.processor import processor
from lerobot_constructskill.envs.recording import RECORDINGS, read_recordings
from lerobot_constructskill.study.rows import read_rows

pytestmark = [pytest.mark.sim, pytest.mark.slow]

STAGES = (
    "demonstrations/*.partial/shards/*/*/episode",
    "checkpoints/*.partial/lerobot-train-*/train_config.json",
    "features/*/spec.json",
    "checkpoints/*/spec.json",
    "runs/*/spec.json",
)
"""Files in the store whose appearance gets a study killed, one after another."""

ACT = {"type": "act", "pretrained_backbone_weights": None, "dim_model": 32, "n_heads": 2, "dim_feedforward": 32}
"""A policy that lerobot-train trains."""

THEIRS = """
from dataclasses import dataclass

from lerobot.configs import PreTrainedConfig
from lerobot.policies.act.configuration_act import ACTConfig

from lerobot_constructskill.rollout.references import REFERENCES, ExpertAgent, Reference
from lerobot_constructskill.training.trainers import Trainer


@PreTrainedConfig.register_subclass("late_act")
@dataclass
class LateACTConfig(ACTConfig):
    study_trainer = "lerobot_policy_late:LateTrainer"


class LateTrainer(Trainer):
    def fit(self, config, dataset, seeds, training, held_out, folder):
        import torch
        from lerobot.policies.factory import make_policy, make_pre_post_processors

        for seed in seeds:
            torch.manual_seed(seed)
            policy = make_policy(ACTConfig(**vars(config)), ds_meta=dataset.meta)
            policy.save_pretrained(folder / f"seed_{seed}")
            for processor in make_pre_post_processors(policy.config, dataset_stats=dataset.meta.stats):
                processor.save_pretrained(folder / f"seed_{seed}")
        return {"late": "by three steps"}


class LateExpert(ExpertAgent):
    def reset(self, seed):
        super().reset(seed)
        self.late = [self.still] * 3

    def act(self, observation):
        self.late.append(super().act(observation))
        return self.late.pop(0)


REFERENCES["late_expert"] = Reference("Expert, three steps late", lambda task, *_: LateExpert(task))
"""
"""Another package: a policy type with a trainer of its own, and a reference."""


@pytest.fixture(scope="module")
def their_package(tmp_path_factory):
    """A folder that holds the package, installed as far as `importlib.metadata` sees."""
    folder = tmp_path_factory.mktemp("site")
    (folder / "lerobot_policy_late.py").write_text(THEIRS)
    metadata = folder / "lerobot_policy_late-1.0.dist-info" / "METADATA"
    metadata.parent.mkdir()
    metadata.write_text("Metadata-Version: 2.1\nName: lerobot_policy_late\nVersion: 1.0\n")
    return folder


@pytest.fixture(scope="module")
def study_file(tmp_path_factory, tiny_weights):
    """Two seeds of two tiny policies, one that cannot be had, all references but the costliest, and others' things."""
    tiny = {"type": "frozen_vit", "backbone": "vit_tiny16", "backbone_path": str(tiny_weights)}
    env = {"task": "brick_to_bin", "episode_length": 8, "obs_type": "pixels_agent_pos"}
    study = {
        "name": "tiny",
        "settings": {"fixed": {"data": "smoke", "env": env}},
        "variants": {
            "tiny": {"policy": tiny, "seeds": 2},
            "learns": {"policy": tiny | {"readout": "attention"}, "seeds": 2},
            "act": {"policy": ACT | {"use_vae": False}, "seeds": 1},
            "theirs": {"policy": ACT | {"use_vae": False, "type": "late_act"}, "seeds": 1},
            "absent": {"policy": tiny | {"backbone_path": "/no/such/weights"}, "seeds": 2},
        },
        "references": {"no_op": 1, "random": 2, "replay": 1, "blind": 1, "expert": 1, "late_expert": 1},
        "training": {"epochs": 1, "batch_size": 64, "holdout": 2},
        "episodes": 2,
    }
    file = tmp_path_factory.mktemp("study") / "tiny.yaml"
    file.write_text(yaml.safe_dump(study, sort_keys=False))
    return file


@pytest.fixture(scope="module")
def flags(study_file):
    """The study's flags, with `<folder>/study` and `<folder>/store`."""
    file = f"--config_path={study_file}"
    return lambda folder: [file, f"--root={folder / 'study'}", f"--store={folder / 'store'}"]


@pytest.fixture(scope="module")
def start(flags, their_package):
    """Start the study in a true process, to be killed."""

    def begin(folder: Path, *options: str, **variables: str) -> subprocess.Popen:
        command = [sys.executable, "-m", "lerobot_constructskill.scripts.study", *flags(folder), *options]
        path = os.pathsep.join(filter(None, [str(their_package), os.environ.get("PYTHONPATH")]))
        log = (folder / "log").open("a")
        quiet = os.environ | OFFLINE | {"PYTHONPATH": path} | variables
        return subprocess.Popen(command, env=quiet, stdout=log, stderr=log, start_new_session=True)

    return begin


@pytest.fixture(scope="module")
def run(flags, their_package):
    """Run the study to its end; return what it said."""
    path = {"PYTHONPATH": str(their_package)}
    return lambda folder, *options, **how: call("constructskill-study", *flags(folder), *options, **path, **how)


@pytest.fixture(scope="module")
def finish(run):
    def until_the_end(folder: Path, *options: str) -> pd.DataFrame:
        run(folder, *options)
        return read_rows(folder / "study" / "rows.parquet")

    return until_the_end


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return tmp_path_factory.mktemp("undisturbed")


@pytest.fixture(scope="module")
def undisturbed(folder, finish):
    return finish(folder)


def wait_for(process: subprocess.Popen, folder: Path, stage: str) -> None:
    while process.poll() is None and not list(folder.glob(f"store/{stage}")):
        time.sleep(0.02)


@pytest.mark.nightly
def test_killed_at_any_stage_it_ends_as_the_undisturbed_one(start, finish, undisturbed, tmp_path):
    for stage in STAGES:
        process = start(tmp_path, "--workers=1")
        wait_for(process, tmp_path, stage)
        os.killpg(process.pid, signal.SIGKILL)
        process.wait()
    pd.testing.assert_frame_equal(finish(tmp_path), undisturbed)


@pytest.mark.nightly
def test_a_seed_after_another_ends_as_both_at_once(finish, undisturbed, tmp_path):
    """In one computation, or side by side in two processes. Rows hold the hashes of demonstrations and weights."""
    some = "--only=fixed/tiny,fixed/learns"
    finish(tmp_path, "--seeds=1", some)
    made = finish(tmp_path, some)
    both = (rows[rows["variant"].isin(["tiny", "learns"])].reset_index(drop=True) for rows in (made, undisturbed))
    pd.testing.assert_frame_equal(*both)


def test_the_rows_say_what_happened(undisturbed):
    finished = undisturbed[undisturbed["error_kind"].isna()]
    assert set(undisturbed["variant"]) - set(finished["variant"]) == {"absent"}, list(undisturbed["error"].dropna())
    counts = finished.groupby("variant").size().to_dict()
    references = {"no_op": 2, "random": 4, "replay": 2, "blind": 2, "expert": 2, "late_expert": 2}
    assert counts == {"tiny": 4, "learns": 4, "act": 2, "theirs": 2} | references
    assert set(finished["steps"]) == {8} and set(finished["evaluation_seed"]) == {1000, 1001}
    assert finished["backend"].str.startswith("physx_cpu").all() and finished["final_error_m"].between(0.1, 1).all()
    assert set(undisturbed.loc[undisturbed["role"] == "sightless", "variant"]) == {"replay", "blind"}
    tiny = finished[finished["variant"] == "tiny"]
    assert tiny["heldout_mse_m2"].between(0, 0.01).all() and tiny["weights_sha256"].nunique() == 2
    assert tiny["versions"].str.contains("vit_tiny16").all()
    assert {json.loads(one)["processor"] for one in finished["versions"]} == {processor()}
    for row in tiny.itertuples():
        assert json.loads(row.heldout_mse_m2_by_data) == {"smoke": row.heldout_mse_m2}
    others = finished[finished["variant"].isin(["act", "theirs"])]
    assert others["heldout_mse_m2"].between(0, 0.1, inclusive="neither").all(), "measured by their checkpoints"
    told = {row.variant: "lerobot_policy_late" in row.versions for row in finished.itertuples()}
    assert {name for name, is_theirs in told.items() if is_theirs} == {"theirs", "late_expert"}
    failed = undisturbed[undisturbed["error_kind"].notna()]
    assert list(failed["variant"]) == ["absent"] * 2 and failed["lifted"].isna().all()
    assert set(failed["error_kind"]) == {"weights"} and failed["error"].str.contains("/no/such/weights").all()
    assert undisturbed["dataset_sha256"].nunique() == 1 and undisturbed["run"].nunique() == 15


def test_a_run_is_a_folder_with_all_that_belongs_to_it(undisturbed, folder):
    for run, rows in undisturbed.groupby("run"):
        row, own = next(rows.itertuples()), folder / "store" / "runs" / run
        assert json.loads((own / "spec.json").read_text())["evaluation"] == {"seed": 1000, "episodes": 2}
        failed, filmed = pd.notna(row.error_kind), pd.notna(row.video)
        trained = row.variant in ("tiny", "learns", "act", "theirs", "blind")
        assert (own / "checkpoint" / "model.safetensors").is_file() == trained
        assert (own / "video.mp4").exists() == filmed == (row.training_seed == 0 and not failed)
        assert not filmed or (folder / "study" / row.video).stat().st_size > 1000
        assert failed or [one.evaluation_seed for one in read_recordings(own / RECORDINGS)] == [1000, 1001]
        assert (own / "log.txt").exists() == failed and (not failed or "Traceback" in (own / "log.txt").read_text())


def test_what_is_there_is_not_made_again_and_a_cut_study_is_put_together(run, finish, undisturbed, folder, tmp_path):
    def made() -> dict[Path, int]:
        return {path: path.stat().st_mtime_ns for path in (folder / "store" / "runs").glob("*/episodes.parquet")}

    before = made()
    (tmp_path / "store").symlink_to(folder / "store")
    pd.testing.assert_frame_equal(finish(tmp_path, "--only=fixed/tiny,fixed/no_op"), undisturbed)
    assert made() == before
    assert "fixed/absent: 0 finished, 2 failed, 0 missing" in run(tmp_path, "--status=true")
    with locked(tmp_path / "study" / ".lock"):
        assert run(tmp_path, fails=True).strip().endswith("at this moment.")


@pytest.mark.nightly
def test_on_a_cluster_it_ends_as_the_undisturbed_one_though_a_machine_dies(
    start, undisturbed, tmp_path, their_package, monkeypatch
):
    pytest.importorskip("ray", reason="the extra `distributed` brings it")
    from ray.cluster_utils import Cluster

    monkeypatch.setenv("PYTHONPATH", str(their_package))  # it is installed on every machine

    cluster = Cluster(initialize_head=True, head_node_args={"num_cpus": 0, "include_dashboard": False})
    try:
        _, mortal = (cluster.add_node(num_cpus=1) for _ in range(2))
        some = ["tiny", "theirs", "replay"]  # four jobs: each starts LeRobot and a simulator in a process of its own
        only = f"--only={','.join(f'fixed/{name}' for name in some)}"
        process = start(tmp_path, "--executor=ray", "--together=1", only, RAY_ADDRESS=cluster.address)
        wait_for(process, tmp_path, STAGES[2])
        cluster.remove_node(mortal, allow_graceful=False)
        assert process.wait() == 0, (tmp_path / "log").read_text()[-2000:]
    finally:
        cluster.shutdown()
    made, wanted = (
        rows[rows["variant"].isin(some)].reset_index(drop=True)
        for rows in (read_rows(tmp_path / "study" / "rows.parquet"), undisturbed)
    )
    pd.testing.assert_frame_equal(made, wanted)
