"""The offline evaluator: what it says of policies whose errors are known, and of real checkpoints."""

import json
import shutil
from contextlib import nullcontext
from dataclasses import asdict, replace
from types import SimpleNamespace

import numpy as np
import pandas as pd
import pytest
import torch
from datasets import Dataset

from lerobot_constructskill.artifacts.digests import data_sha256
from lerobot_constructskill.dataset import hub
from lerobot_constructskill.errors import InputError, UserError
from lerobot_constructskill.lerobot_internals import TRAIN_CONFIG
from lerobot_constructskill.policies.frozen_vit.train_seeds import save_checkpoint, train_seeds
from lerobot_constructskill.rollout.agents import PolicyAgent
from lerobot_constructskill.rollout.offline import (
    Predictions,
    check_actions,
    heldout_mse,
    observing_frames,
    offline_metrics,
    open_for,
    policy_errors,
    predict,
    spans,
)
from lerobot_constructskill.scripts.held_out import OfflineConfig, evaluate_offline
from lerobot_constructskill.training.recipe import FACTS, Training

EPISODES, CHUNK = [3, 7], 5
SHIFT = np.array([0.001, -0.002, 0.002, 0], dtype=np.float32)
"""Metres; 3 mm long."""


class Oracle:
    """A policy that recognises the frame and repeats its labels, `shift` added."""

    name = "oracle"

    def __init__(self, dataset, shift=SHIFT * 0):
        rows = dataset.hf_dataset.with_format("torch")
        self.seen, self.actions = rows["observation.features.base"][:], rows["action"][:]
        self.shift = torch.from_numpy(shift)

    def reset(self):
        pass

    def predict_action_chunk(self, batch):
        frames = torch.cdist(batch["observation.features.base"], self.seen).argmin(1)
        steps = (frames[:, None] + torch.arange(CHUNK)).clamp(max=len(self.actions) - 1)
        return self.actions[steps] + self.shift


class WithoutChunks(Oracle):
    def predict_action_chunk(self, batch):
        raise NotImplementedError

    def select_action(self, batch):
        return super().predict_action_chunk(batch)[:, 0]


def as_it_is(batch):
    return batch


def measure(policy, dataset):
    agent = SimpleNamespace(policy=policy, preprocessor=as_it_is, postprocessor=as_it_is)
    return offline_metrics([predict(agent, dataset, span, 7) for span in spans(dataset, EPISODES)])


def test_a_policy_that_repeats_the_labels_has_no_error(feature_set):
    metrics = measure(Oracle(feature_set), feature_set)
    assert metrics.frames == sum(feature_set.meta.episodes["length"][i] for i in EPISODES)
    assert metrics.rmse_m == metrics.mean_m == metrics.consistency_m == 0
    assert metrics.gripper_accuracy == metrics.gripper_change_accuracy == 1
    assert metrics.rmse_rotation_rad is None


def test_a_constant_shift_is_found_in_metres(feature_set):
    metrics = measure(Oracle(feature_set, SHIFT), feature_set)
    found = [metrics.rmse_dx_m, metrics.rmse_dy_m, metrics.rmse_dz_m]
    np.testing.assert_allclose(found, np.abs(SHIFT[:3]), atol=1e-6)
    assert metrics.rmse_m == pytest.approx(0.003, abs=1e-6) and metrics.mean_m == pytest.approx(0.003, abs=1e-6)
    assert metrics.consistency_m == pytest.approx(0, abs=1e-6)


def test_a_policy_of_two_observations_is_shown_two_and_the_labels_of_one(feature_set):
    asks = SimpleNamespace(observation_delta_indices=[-1, 0], action_delta_indices=[0, 1], reward_delta_indices=None)
    view = open_for(feature_set, SimpleNamespace(config=asks))
    both = torch.stack([feature_set[frame]["observation.state"] for frame in (4, 5)])
    assert torch.equal(view[5]["observation.state"], both) and view[5]["action"].shape == (4,)


def test_a_policy_without_chunks_has_no_consistency(feature_set):
    metrics, chunked = (measure(kind(feature_set, SHIFT), feature_set) for kind in (WithoutChunks, Oracle))
    assert metrics.consistency_m is None
    assert asdict(metrics) == asdict(chunked) | {"consistency_m": None}


def demonstration(length=40, changes=(10, 30), dims=4):
    """Labels (T, A) of a gripper that closes and opens again."""
    labels = np.random.default_rng(0).normal(scale=0.02, size=(length, dims)).astype(np.float32)
    labels[:, -1] = 1
    labels[slice(*changes), -1] = -1
    return labels


def test_a_gripper_that_never_moves_gets_half_of_the_changes():
    labels = demonstration()
    still = labels.copy()
    still[:, -1] = 1
    metrics = offline_metrics([Predictions(labels, still[:, None])])
    assert (metrics.gripper_accuracy, metrics.gripper_change_accuracy) == (0.5, 0.5)


def test_a_gripper_that_is_a_step_late_is_wrong_in_the_frame_after_each_change_and_right_before_it():
    labels = demonstration()
    late = labels.copy()
    late[1:, -1] = labels[:-1, -1]
    metrics = offline_metrics([Predictions(labels, late[:, None])])
    assert (metrics.gripper_accuracy, metrics.gripper_change_accuracy) == (0.95, 0.5)


def test_chunks_that_drift_disagree_by_their_drift_and_beyond_the_end_nothing_counts():
    labels = demonstration()
    drift = np.arange(CHUNK)[:, None] * SHIFT
    steps = np.arange(len(labels))[:, None] + np.arange(CHUNK)
    chunks = labels[steps.clip(max=len(labels) - 1)] + drift
    chunks[steps >= len(labels)] = 99
    metrics = offline_metrics([Predictions(labels, chunks)])
    assert metrics.consistency_m == pytest.approx(0.003, abs=1e-6) and metrics.rmse_m == 0


def test_rotation_is_apart_from_translation():
    labels = demonstration(dims=5)
    turned = labels.copy()
    turned[:, 3] += 0.1
    metrics = offline_metrics([Predictions(labels, turned[:, None])])
    assert metrics.rmse_m == 0 and metrics.rmse_rotation_rad == pytest.approx(0.1, abs=1e-6)


def said(seed: int, holdout: int) -> dict:
    """What a study says of a checkpoint."""
    return {"seed": seed, "training": asdict(Training(holdout=holdout)), "made_of": {}}


def test_checkpoints_become_rows_that_say_what_they_were_asked(config, feature_set, tmp_path):
    """For chunks of one step the error is the one that a study measures on the same held-out episodes."""
    trained = train_seeds(config(chunk_size=1), feature_set, [0, 1], epochs=3, batch_size=16, held_out=EPISODES)
    for policy, seed in zip(trained, [0, 1], strict=True):
        save_checkpoint(policy, feature_set, tmp_path / f"checkpoint_{seed}")
        (tmp_path / f"checkpoint_{seed}" / FACTS).write_text(json.dumps(said(seed, 8)))
    found = f"{tmp_path}/checkpoint_*"
    asked = OfflineConfig(
        policies=[found], repo_id="local/random", root=feature_set.root, episodes=EPISODES, out=tmp_path
    )
    printed = evaluate_offline(asked)
    rows, table = json.loads((tmp_path / "offline.json").read_text()), pd.read_parquet(tmp_path / "offline.parquet")
    assert "n/a" in printed and [row["policy"] for row in rows] == ["frozen_vit"] * 2
    assert list(table["training_seed"]) == [0, 1]
    assert list(table["rmse_m"]) == [row["rmse_m"] for row in rows]
    for row, checkpoint in zip(rows, sorted(tmp_path.glob("checkpoint_*")), strict=True):
        error = heldout_mse(checkpoint, feature_set, EPISODES)
        assert row["rmse_m"] ** 2 / 3 == pytest.approx(error, rel=1e-4)
    assert rows[0]["weights_sha256"] != rows[1]["weights_sha256"]
    assert rows[0]["dataset_sha256"] == rows[1]["dataset_sha256"] and rows[0]["episodes"] == "3,7"


@pytest.mark.parametrize("readout", ["spatial_softmax", "mean"])
def test_a_readout_of_patches_is_evaluated_on_their_features(readout, config, feature_set, tmp_path):
    fields = config(chunk_size=1, readout=readout)
    (trained,) = train_seeds(fields, feature_set, [0], epochs=1, batch_size=16, held_out=EPISODES)
    save_checkpoint(trained, feature_set, tmp_path / "checkpoint")
    found = [str(tmp_path / "checkpoint")]
    asked = OfflineConfig(
        policies=found, repo_id="local/random", root=feature_set.root, episodes=EPISODES, out=tmp_path
    )
    evaluate_offline(asked)
    (row,) = json.loads((tmp_path / "offline.json").read_text())
    error = heldout_mse(tmp_path / "checkpoint", feature_set, EPISODES)
    assert row["rmse_m"] ** 2 / 3 == pytest.approx(error, rel=1e-4)


def test_features_of_another_encoder_are_not_scored(checkpoint, feature_set, tmp_path):
    other = shutil.copytree(feature_set.root, tmp_path / "other")
    info = json.loads((other / "meta" / "info.json").read_text())
    info["features"]["observation.features.base"]["info"]["weights_sha256"] = "0" * 64
    (other / "meta" / "info.json").write_text(json.dumps(info))
    with pytest.raises(InputError, match="not made by this policy's encoder: weights_sha256 0000"):
        evaluate_offline(
            OfflineConfig(
                policies=[str(checkpoint)], repo_id="local/random", root=other, episodes=EPISODES, out=tmp_path
            )
        )
    assert not (tmp_path / "offline.json").exists()


@pytest.mark.parametrize(
    ("told", "seen"),
    [
        ({}, "2 episodes of those that are held out by default, episode 3 for one"),
        ({"eval_split": 0.125}, "1 episode of those that are held out by default, episode 3"),
        ({"episodes": [0, 1, 2, 4, 5, 6, 3, 7], "eval_split": 0.25}, None),
        ({"episodes": [0, 1, 2]}, None),
        ({"episodes": [0, 1, 2, 8]}, None),  # of a set of that name that has been made again, with fewer
        ({"repo_id": "local/another"}, None),
    ],
    ids=str,
)
def test_what_a_checkpoint_was_trained_on_is_not_held_out(told, seen, checkpoint, feature_set, tmp_path, monkeypatch):
    """Not by default: whoever names an episode may have a reason."""
    monkeypatch.setattr(hub, "held_out_of", lambda dataset: EPISODES)  # every fourth of eight
    trained = shutil.copytree(checkpoint, tmp_path / "checkpoint")
    (trained / TRAIN_CONFIG).write_text(json.dumps({"dataset": {"repo_id": "local/random"} | told}))
    asked = OfflineConfig(policies=[str(trained)], repo_id="local/random", root=feature_set.root, out=tmp_path)
    with pytest.raises(InputError, match=seen) if seen else nullcontext():
        evaluate_offline(asked)
    evaluate_offline(replace(asked, episodes=EPISODES))


def of_tasks(*tasks_and_numbers) -> SimpleNamespace:
    """The metadata of a set with so many episodes of each task, one after another."""
    pairs = zip(tasks_and_numbers[::2], tasks_and_numbers[1::2], strict=True)
    rows = [{"tasks": [task]} for task, number in pairs for _ in range(number)]
    return SimpleNamespace(episodes=Dataset.from_list(rows))


def test_lerobot_holds_out_of_each_task(tmp_path):
    """As its `make_train_eval_datasets`: the last of two tasks of eight."""
    (tmp_path / TRAIN_CONFIG).write_text(json.dumps({"dataset": {"repo_id": "a/b", "eval_split": 0.125}}))
    asked = SimpleNamespace(repo_id="a/b", num_episodes=16, root=tmp_path, meta=of_tasks("lift", 8, "turn", 8))
    assert hub.trained_on(tmp_path, asked) == set(range(16)) - {7, 15}


def test_what_a_checkpoint_was_trained_on_the_features_of_is_not_held_out(tmp_path):
    (tmp_path / "features" / "meta").mkdir(parents=True)
    (tmp_path / "copy" / "data").mkdir(parents=True)
    (tmp_path / "copy" / "data" / "file").write_text("frames")
    plain = {"dtype": "float32", "shape": [1]}
    column = plain | {"info": {"source_repo_id": "alice/set", "source_sha256": data_sha256(tmp_path / "copy")}}
    described = {"features": {"observation.features.base": column, "action": plain | {"info": None}, "index": plain}}
    (tmp_path / "features" / "meta" / "info.json").write_text(json.dumps(described))
    told = {
        "repo_id": "alice/set_encoded",
        "root": str(tmp_path / "features"),
        "episodes": [2, 0, 1],
        "eval_split": 0.3,
    }
    (tmp_path / TRAIN_CONFIG).write_text(json.dumps({"dataset": told}))
    for repo_id, root, episodes in (
        ("alice/set", "nothing", {0, 2}),
        ("alice/set_encoded", "nothing", {0, 2}),
        ("alice/other", "features", {0, 2}),
        ("alice/other", "copy", {0, 2}),
        ("alice/other", "nothing", set()),
    ):
        asked = SimpleNamespace(repo_id=repo_id, num_episodes=4, root=tmp_path / root, meta=of_tasks("a", 4))
        assert hub.trained_on(tmp_path, asked) == episodes
        assert not hub.trained_on(tmp_path / "nothing", asked)


def test_of_a_checkpoint_that_says_nothing_of_its_training_set_a_line_is_said(tmp_path, monkeypatch, caplog):
    home = tmp_path / "home"
    (home / "alice" / "encoded" / "meta").mkdir(parents=True)
    column = {"dtype": "float32", "shape": [1], "info": {"source_repo_id": "alice/set", "source_sha256": "0"}}
    (home / "alice" / "encoded" / "meta" / "info.json").write_text(json.dumps({"features": {"a": column}}))
    monkeypatch.setattr("lerobot.utils.constants.HF_LEROBOT_HOME", home)
    asked = SimpleNamespace(repo_id="alice/set", num_episodes=16, root=tmp_path / "nothing", meta=of_tasks("a", 16))
    for number, (file, told, seen) in enumerate(
        (
            (TRAIN_CONFIG, {"dataset": {"repo_id": "alice/encoded", "root": None}}, set(range(16))),
            (TRAIN_CONFIG, {"dataset": {"repo_id": "alice/encoded", "root": "gone"}}, None),
            (FACTS, said(0, 8), set()),
            (FACTS, said(0, 5), None),
            ("no_file", {}, None),
        )
    ):
        checkpoint = tmp_path / str(number)
        checkpoint.mkdir()
        (checkpoint / file).write_text(json.dumps(told))
        assert hub.trained_on(checkpoint, asked) == seen, told
        caplog.clear()
        with pytest.raises(InputError) if seen else nullcontext():
            assert hub.choose_held_out(asked, None, [checkpoint]) == [7, 15]
        assert [record.getMessage() for record in caplog.records] == (
            [f"Whether '{checkpoint}' was trained on the held-out episodes [7, 15] cannot be told."] * (seen is None)
        )


def test_a_policy_that_says_what_its_labels_say_has_no_errors():
    """Whichever expert they are of: with noise, without, or with the advice from the state alone."""
    clean, noise, advice = np.float32([0.01, 0, -0.02, 1]), np.float32([0.003, 0.001, 0]), np.float32([0, 0, 0.03, -1])
    executed = clean + np.append(noise, np.float32(0))
    for labels, action in (("clean", clean), ("executed", executed), ("advice", advice)):
        wanted = clean if labels == "executed" else action
        columns = {"action": action, "dart.executed_action": executed, "dart.noise": noise}
        frame = {name: torch.from_numpy(value) for name, value in columns.items()} | {"task": "", "phase": "CARRY"}
        row = {"dataset_from_index": 0, "dataset_to_index": 2}
        agent = SimpleNamespace(
            reset=lambda episode: None, preprocessor=as_it_is, decide=lambda batch, wanted=wanted: wanted
        )
        dataset = FakeDataset([frame] * 2)
        dataset.meta = SimpleNamespace(episodes=[row])
        np.testing.assert_allclose(policy_errors(agent, dataset, 0, ["CARRY"], labels), np.zeros((2, 3)), atol=1e-9)


class FakeDataset(list):
    """Frames, and a place for what is said of them."""


def test_what_is_not_there_is_refused_in_one_sentence(feature_set, tmp_path):
    with pytest.raises(FileNotFoundError, match="matches no checkpoint"):
        evaluate_offline(
            OfflineConfig(policies=[str(tmp_path / "none")], repo_id="local/random", root=feature_set.root)
        )
    (tmp_path / "config.json").touch()
    with pytest.raises(ValueError, match="must be among 0 to 7"):
        evaluate_offline(
            OfflineConfig(policies=[str(tmp_path)], repo_id="local/random", root=feature_set.root, episodes=[8])
        )


@pytest.mark.parametrize(
    ("names", "said"),
    [
        (["x", "y", "z", "gripper"], "must have the actions dx, dy, dz"),
        (["dx", "dy", "dz"], "must have the actions dx, dy, dz"),
        (None, "must have the actions dx, dy, dz"),
        (["dx", "dy", "dz", "dyaw", "gripper"], "The policy acts in"),
    ],
)
def test_a_policy_is_not_compared_with_other_actions(config, feature_set, names, said):
    policy = train_seeds(config(chunk_size=1), feature_set, [0], epochs=1, batch_size=16)[0]
    check_actions(policy, feature_set)
    other = SimpleNamespace(repo_id="a/b", meta=SimpleNamespace(features={"action": {"names": names}}))
    with pytest.raises(ValueError, match=said):
        check_actions(policy, other)


def test_an_observation_that_is_not_there_is_a_sentence(feature_set):
    said = "reads observation.images.wrist, which it is not shown: 'local/random' has observation.features"
    with pytest.raises(ValueError, match=said), observing_frames(feature_set):
        raise KeyError("observation.images.wrist")
    with pytest.raises(KeyError), observing_frames(feature_set):
        raise KeyError("a fault of ours")


@pytest.fixture(scope="module")
def checkpoint(config, feature_set, tmp_path_factory):
    folder = tmp_path_factory.mktemp("checkpoint")
    policy = train_seeds(config(chunk_size=1), feature_set, [0], epochs=1, batch_size=16)[0]
    save_checkpoint(policy, feature_set, folder)
    return folder


@pytest.mark.parametrize(
    "content", ["[]", "{}", "null", "", '{"type": "frozen_vit", "chunk_size": NaN}', '{"type": 3}']
)
@pytest.mark.parametrize("file", ["config.json", "model.safetensors", "policy_preprocessor.json"])
def test_a_damaged_checkpoint_is_a_sentence(checkpoint, tmp_path, file, content):
    damaged = shutil.copytree(checkpoint, tmp_path / "damaged")
    (damaged / file).write_text(content)
    with pytest.raises(UserError) as refusal:
        PolicyAgent.from_pretrained(damaged)
    assert "\n" not in str(refusal.value)
