"""There and back on a Hub on loopback: push, train from the name, evaluate, push the policy, evaluate it by name."""

import json

import pytest
from commands import call
from hub_server import TOKENS, serve
from toy import ToyEnv

from lerobot_constructskill.demos import shards
from lerobot_constructskill.demos.recorder import GenerateConfig, record
from lerobot_constructskill.scripts.push_policy import seed_outcomes

TOKEN = next(iter(TOKENS))
ENV = ["--env.type=constructskill", "--env.obs_type=pixels_agent_pos", "--env.episode_length=6"]
EVAL = [*ENV, "--eval.n_episodes=1", "--eval.batch_size=1", "--policy.device=cpu"]
ACT = ["--policy.type=act", "--policy.dim_model=64", "--policy.n_heads=2", "--policy.dim_feedforward=64"]
SMALL = ["--policy.use_vae=false", "--policy.pretrained_backbone_weights=null", "--policy.device=cpu"]
SHORT = ["--steps=2", "--save_freq=2", "--batch_size=2", "--num_workers=0", "--policy.push_to_hub=false", "--seed=7"]


@pytest.mark.sim
@pytest.mark.slow
def test_a_data_set_and_a_policy_go_to_the_hub_and_come_back(tmp_path, monkeypatch):
    monkeypatch.setattr(shards, "_environment", ToyEnv)
    root, evaluations = tmp_path / "set", tmp_path / "eval"
    record(GenerateConfig("local/toy", str(root), episodes=2, obs_type="pixels_agent_pos"))
    with serve() as hub:
        online = {"HF_ENDPOINT": hub.url, "HF_HUB_OFFLINE": "0", "HF_HUB_DISABLE_XET": "1", "HF_TOKEN": TOKEN}
        online["HF_HOME"] = str(tmp_path / "home")

        def run(*command):
            assert TOKEN not in call(*map(str, command), **online)

        run("constructskill-push", "--repo_id=alice/set", f"--root={root}")
        source = ["--dataset.repo_id=alice/set", "--dataset.revision=v3.0"]
        run("lerobot-train", *ACT, *SMALL, *SHORT, *source, f"--output_dir={tmp_path / 'act'}")
        checkpoint = tmp_path / "act" / "checkpoints" / "000002" / "pretrained_model"
        run("lerobot-eval", f"--policy.path={checkpoint}", *EVAL, f"--output_dir={evaluations / 'seed_7'}")
        flags = [
            f"--policy_path={checkpoint}",
            f"--evaluations={evaluations}",
            "--repo_id=alice/act",
            "--task=brick_to_bin",
        ]
        saved = json.loads((checkpoint / "config.json").read_text())
        (checkpoint / "config.json").write_text(json.dumps(saved | {"device": "cuda"}))  # trained on another machine
        run("constructskill-push-policy", *flags)
        run("lerobot-eval", "--policy.path=alice/act", *EVAL, f"--output_dir={tmp_path / 'again'}")
        assert len(hub.repos["models/alice/act"].commits) == 2, "the empty one, and that of weights and card"
        files = hub.repos["models/alice/act"].commits[hub.repos["models/alice/act"].branches["main"]]
        card = hub.blobs[files["README.md"][0]].decode()
        assert json.loads(hub.blobs[files["config.json"][0]])["device"] == "cuda", "and pushed from here"
    assert "library_name: lerobot" in card and "| 7 (this one) | 0/1 | 0/1 |" in card
    assert "Trained on `alice/set`, revision `v3.0`." in card
    assert {"model.safetensors", "config.json", "train_config.json", "policy_preprocessor.json"} <= set(files)
    assert (tmp_path / "again" / "eval_info.json").is_file()
    assert all(TOKEN.encode() not in content for content in hub.blobs.values())


def test_outcomes_are_counted_by_stage_and_seed(tmp_path):
    for seed, stages in ((10, [0.5, 1.0, 0.0]), (2, [0.0])):
        folder = tmp_path / f"seed_{seed}"
        folder.mkdir()
        metrics = {"successes": [stage == 1 for stage in stages], "max_rewards": stages}
        told = {"per_task": [{"task_group": "loose", "task_id": 0, "metrics": metrics}]}
        (folder / "eval_info.json").write_text(json.dumps(told))
    assert seed_outcomes(tmp_path) == [(2, 0, 0, 1), (10, 2, 1, 3)]
    with pytest.raises(FileNotFoundError, match="lerobot-eval"):
        seed_outcomes(tmp_path / "seed_2")
