"""LeRobot's other policies, made small, with the shipped configurations and LeRobot's own scripts as subprocesses.

pi0 and pi0.5 are not run here: they have 3 billion parameters. tests/test_configs.py checks their files.
"""

import json
from functools import cache
from pathlib import Path

import pytest
import yaml
from commands import QUICK, call
from tokenizers import Tokenizer
from tokenizers.models import WordLevel
from tokenizers.pre_tokenizers import Whitespace
from transformers import PreTrainedTokenizerFast, SmolVLMConfig, SmolVLMImageProcessor, SmolVLMProcessor
from transformers.models.smolvlm.video_processing_smolvlm import SmolVLMVideoProcessor

from lerobot_constructskill.analysis.report.page import write_report
from lerobot_constructskill.contract import ORDERS, TASKS
from lerobot_constructskill.demos.recorder import GenerateConfig, record
from lerobot_constructskill.parsing import read_fields
from lerobot_constructskill.presets import find
from lerobot_constructskill.scripts.config import ConfigConfig, write
from lerobot_constructskill.scripts.held_out import OfflineConfig, evaluate_offline
from lerobot_constructskill.study.rows import ROWS, VARIANT, read_rows

pytestmark = [pytest.mark.sim, pytest.mark.nightly]

SMALL = {
    "act": [
        "--policy.pretrained_backbone_weights=null",
        "--policy.dim_model=64",
        "--policy.n_heads=2",
        "--policy.dim_feedforward=64",
    ],
    "diffusion": [
        "--policy.pretrained_backbone_weights=null",
        "--policy.down_dims=[32,64]",
        "--policy.diffusion_step_embed_dim=16",
        "--policy.num_inference_steps=2",
    ],
    "smolvla": ["--policy.num_steps=2"],
    "smolvla_suite": ["--policy.num_steps=2"],
}
"""Flags that make a policy small; none of them is about data set, environment or chunks."""

SEVEN = {"task": "brick_to_bin,brick_to_bin_turned", "action": "full"}
"""Fields of a set and of its environment: two tasks with an action of seven numbers, for `train/*_suite`."""


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return tmp_path_factory.mktemp("any_policy")


@pytest.fixture(scope="module")
def demonstrations(folder):
    """Record two lossless demonstrations with both cameras and the state, of one task or each of those of `SEVEN`."""

    @cache
    def make(is_suite: bool) -> Path:
        root = folder / ("suite" if is_suite else "demonstrations")
        fields = {"obs_type": "pixels_agent_pos", "video": "lossless"} | (SEVEN if is_suite else {})
        record(GenerateConfig("local/demos", str(root), episodes=2, **fields))
        return root

    return make


def write_vlm(folder: Path) -> None:
    """A SmolVLM that knows the words of every instruction: configuration, tokenizer and processor, no weights."""
    named = {
        "image_token": "<image>",
        "fake_image_token": "<fake_token_around_image>",
        "global_image_token": "<global-img>",
        "end_of_utterance_token": "<end_of_utterance>",
    }
    splitter = Whitespace()
    instructions = " ".join(task.instruction for task in TASKS.values())
    words = dict.fromkeys(word for word, _ in splitter.pre_tokenize_str(instructions))
    vocabulary = {word: i for i, word in enumerate(["<unk>", "<pad>", *named.values(), *words])}
    tokenizer = Tokenizer(WordLevel(vocabulary, unk_token="<unk>"))
    tokenizer.pre_tokenizer = splitter
    wrapped = PreTrainedTokenizerFast(
        tokenizer_object=tokenizer, unk_token="<unk>", pad_token="<pad>", extra_special_tokens=named
    )
    SmolVLMProcessor(SmolVLMImageProcessor(), wrapped, SmolVLMVideoProcessor()).save_pretrained(folder)
    layers = {"hidden_size": 32, "intermediate_size": 64, "num_hidden_layers": 2, "num_attention_heads": 2}
    text = layers | {"num_key_value_heads": 1, "head_dim": 16, "vocab_size": len(vocabulary), "pad_token_id": 1}
    vision = layers | {"image_size": 64, "patch_size": 16}
    SmolVLMConfig(
        text_config=text, vision_config=vision, scale_factor=2, image_token_id=vocabulary["<image>"], pad_token_id=1
    ).save_pretrained(folder)


@pytest.fixture(scope="module")
def smolvla_base(folder):
    """What lerobot/smolvla_base is, with random weights: three cameras and six numbers of state and action."""
    from lerobot.configs import FeatureType, PolicyFeature
    from lerobot.policies.factory import make_pre_post_processors
    from lerobot.policies.smolvla.configuration_smolvla import SmolVLAConfig
    from lerobot.policies.smolvla.modeling_smolvla import SmolVLAPolicy

    write_vlm(folder / "vlm")
    image = PolicyFeature(FeatureType.VISUAL, (3, 256, 256))
    state, action = PolicyFeature(FeatureType.STATE, (6,)), PolicyFeature(FeatureType.ACTION, (6,))
    config = SmolVLAConfig(
        device="cpu",
        input_features={f"observation.images.camera{i}": image for i in (1, 2, 3)} | {"observation.state": state},
        output_features={"action": action},
        resize_imgs_with_padding=(64, 64),
        vlm_model_name=str(folder / "vlm"),
    )
    base = folder / "smolvla_base"
    for part in (SmolVLAPolicy(config), *make_pre_post_processors(config)):
        part.save_pretrained(base)
    return base


@pytest.fixture(scope="module", params=SMALL)
def trained(request, folder, demonstrations):
    """Name, checkpoint after two steps of `lerobot-train`, and set of a configuration; episode 1 is held out."""
    kind, out = request.param, folder / request.param
    is_suite = kind.endswith("_suite")
    root, episodes = demonstrations(is_suite), [0, 1, 2, 3] if is_suite else [0, 1]
    base = [f"--policy.path={request.getfixturevalue('smolvla_base')}"] if kind.startswith("smolvla") else []
    data = [f"--dataset.root={root}", f"--dataset.episodes={episodes}", "--dataset.eval_split=0.4"]
    written = write(ConfigConfig(f"train/{kind}", root))
    flags = [f"--config_path={written}", *data, *base, *SMALL[kind], *QUICK, "--batch_size=2"]
    log = call("lerobot-train", *flags, "--steps=2", "--eval_steps=2", "--max_eval_samples=2", f"--output_dir={out}")
    assert "eval_loss=" in log
    return kind, out / "checkpoints" / "last" / "pretrained_model", root


def test_a_policy_trains_on_the_data_set_is_saved_and_runs_in_the_environment(trained, folder):
    kind, checkpoint, _ = trained
    fields = SEVEN if kind.endswith("_suite") else {"task": "brick_to_bin"}
    renames = json.loads((checkpoint / "train_config.json").read_text())["rename_map"]
    env = ["--env.type=constructskill", "--env.obs_type=pixels_agent_pos", "--env.episode_length=6"]
    env += [f"--env.{name}={value}" for name, value in fields.items()]
    one = ["--eval.n_episodes=1", "--eval.batch_size=1", f"--output_dir={folder / 'eval' / kind}"]
    call("lerobot-eval", f"--policy.path={checkpoint}", f"--rename_map={json.dumps(renames)}", *env, *one)
    info = json.loads((folder / "eval" / kind / "eval_info.json").read_text())
    assert info["overall"]["n_episodes"] == len(fields["task"].split(","))
    assert Path(info["overall"]["video_paths"][0]).stat().st_size > 1000


def test_a_policy_is_evaluated_offline(trained):
    kind, checkpoint, root = trained
    out = checkpoint.parent / "offline"
    evaluate_offline(
        OfflineConfig(policies=[str(checkpoint)], repo_id="local/demos", root=root, episodes=[1], out=out)
    )
    (row,) = json.loads((out / "offline.json").read_text())
    assert (row["policy"], row["training_seed"]) == (kind.removesuffix("_suite"), 1000)
    assert 0.001 < row["mean_m"] <= row["rmse_m"] < 0.3 and 0 < row["consistency_m"] < 0.3
    assert 0 <= row["gripper_accuracy"] <= 1 and 0 <= row["gripper_change_accuracy"] <= 1


def test_the_study_of_vlas_runs_whole(smolvla_base, folder):
    """With a tiny SmolVLA of random weights beside the real frozen_vit, two seeds, an epoch and short episodes."""
    fields = read_fields(find("study", "vla"))
    policy = fields["variants"]["smolvla"]["policy"]
    policy |= {"device": "cpu", "pretrained_path": str(smolvla_base), "num_steps": 2}
    policy |= {"vlm_model_name": str(folder / "vlm"), "resize_imgs_with_padding": [64, 64]}
    for variant in fields["variants"].values():
        variant |= {"seeds": 2, "training": {"epochs": 1}}
    for setting in fields["settings"].values():
        setting["data"] += " --episodes=1 --video=av1"
        setting["env"] |= {"episode_length": 4}
    file, root = folder / "vla.yaml", folder / "vla"
    file.write_text(
        yaml.safe_dump(fields | {"episodes": 1, "training": {"batch_size": 256}, "references": {"expert": 1}})
    )
    call("constructskill-study", str(file), f"--root={root}", f"--store={folder / 'store'}")
    rows = read_rows(root / ROWS)
    assert rows["error"].isna().all() and {*rows["variant"]} == {"smolvla", "told", "expert"}
    trained = rows[rows["role"] == VARIANT].groupby(["variant", "training_seed"])
    assert all(sorted(one["setting"]) == sorted(ORDERS) for _, one in trained) and len(trained) == 4
    assert (trained["weights_sha256"].nunique() == 1).all(), "one policy for all four"

    page = write_report(root).with_suffix(".md").read_text()
    of_means = page.partition("\n## all orders\n")[2].partition("\n## ")[0]
    means, spread = of_means.split("### The same comparisons of the spread over seeds")
    pair = "| SmolVLA, fine-tuned v frozen\\_vit, told by language |"
    assert "mean over the tasks of each seed" in means and "not run yet" not in means
    assert means.count(pair) == 2 and spread.count(pair) == 1, "lifted, placed; spread"
