"""Save, load, and what is said when a checkpoint is not what it should be."""

import json
import shutil
from pathlib import Path
from types import SimpleNamespace

import pytest
import torch
from huggingface_hub import HfApi, ModelCard
from lerobot.configs import PreTrainedConfig
from lerobot.policies import factory, pretrained
from safetensors.torch import load_file, load_model, save_file

from lerobot_constructskill.errors import UserError
from lerobot_constructskill.policies.frozen_vit import modeling_frozen_vit
from lerobot_constructskill.policies.frozen_vit import weights as weights_module
from lerobot_constructskill.policies.frozen_vit.configuration_frozen_vit import FrozenViTChunkConfig
from lerobot_constructskill.policies.frozen_vit.modeling_frozen_vit import FrozenViTChunkPolicy


@pytest.fixture
def local_weights(weights, tmp_path) -> Path:
    """A copy of the tiny backbone's weights that a test may take away."""
    shutil.copytree(weights("vit_tiny16"), tmp_path / "weights")
    return tmp_path / "weights"


def edit_config(checkpoint: Path, **fields: object) -> None:
    edit_json(checkpoint / "config.json", **fields)


def edit_json(path: Path, **fields: object) -> None:
    path.write_text(json.dumps(json.loads(path.read_text()) | fields))


@pytest.mark.slow
@pytest.mark.parametrize("save_backbone", [True, False])
def test_a_loaded_checkpoint_acts_the_same(save_backbone, make_policy, local_weights, images, tmp_path, caplog):
    policy = make_policy(save_backbone=save_backbone, backbone_path=str(local_weights)).eval()
    policy.save_pretrained(tmp_path / "checkpoint")
    if save_backbone:
        shutil.rmtree(local_weights)  # a checkpoint that holds its backbone needs no other source
    for strict in (False, True):
        loaded = FrozenViTChunkPolicy.from_pretrained(tmp_path / "checkpoint", strict=strict)
        batch = {"observation.images.base": images}
        torch.testing.assert_close(loaded.select_action(batch), policy.select_action(batch))
        policy.reset()
    assert loaded.encoder_record == policy.encoder_record
    assert loaded.encoder_record.source == f"local {local_weights.name}"
    assert loaded.config.backbone_sha256 is None, "nobody asked for it"
    assert "issing key" not in caplog.text
    holds = any("backbone" in name for name in load_file(tmp_path / "checkpoint" / "model.safetensors"))
    assert holds == save_backbone


@pytest.mark.parametrize("save_backbone", [True, False])
def test_state_dicts_load_strictly(save_backbone, make_policy, tmp_path):
    policy = make_policy(save_backbone=save_backbone)
    policy.load_state_dict(policy.state_dict(), strict=True)
    policy.save_pretrained(tmp_path)
    assert load_model(policy, tmp_path / "model.safetensors", strict=True) == (set(), [])


@pytest.mark.slow
def test_a_checkpoint_can_be_fine_tuned_with_the_other_choice(make_policy, images, tmp_path):
    policy = make_policy(save_backbone=False).eval()
    policy.save_pretrained(tmp_path / "small")
    edit_config(tmp_path / "small", save_backbone=True)
    whole = FrozenViTChunkPolicy.from_pretrained(tmp_path / "small")
    whole.save_pretrained(tmp_path / "whole")
    edit_config(tmp_path / "whole", save_backbone=False, backbone_path="gone")
    again = FrozenViTChunkPolicy.from_pretrained(tmp_path / "whole")
    batch = {"observation.images.base": images}
    torch.testing.assert_close(again.select_action(batch), policy.select_action(batch))


def test_a_small_checkpoint_loads_where_its_path_is_gone(make_policy, local_weights, weights, tmp_path, monkeypatch):
    """The Hub is faked by a local file."""
    make_policy(save_backbone=False, backbone_path=str(local_weights)).save_pretrained(tmp_path / "checkpoint")
    shutil.rmtree(local_weights)
    monkeypatch.setattr(weights_module, "hub_file", lambda *_: weights("vit_tiny16") / "model.safetensors")
    loaded = FrozenViTChunkPolicy.from_pretrained(tmp_path / "checkpoint")
    assert loaded.encoder_record.source.startswith("hub ")


@pytest.mark.parametrize("trained", [True, False])
def test_another_choice_of_standardising_is_refused(trained, make_policy, tmp_path):
    stats = {"observation.features.base": {"mean": torch.ones(192), "std": torch.ones(192)}}
    make_policy(standardize_features=trained, dataset_stats=stats).save_pretrained(tmp_path)
    FrozenViTChunkPolicy.from_pretrained(tmp_path)
    config = PreTrainedConfig.from_pretrained(tmp_path)
    config.standardize_features = not trained
    with pytest.raises(ValueError, match=f"trained with standardize_features={trained}, so it cannot") as refusal:
        FrozenViTChunkPolicy.from_pretrained(tmp_path, config=config)
    assert "\n" not in str(refusal.value)


def test_other_backbone_weights_are_refused(make_policy, weights, tmp_path):
    for save_backbone in (True, False):
        make_policy(save_backbone=save_backbone).save_pretrained(tmp_path / str(save_backbone))
    file = tmp_path / "True" / "model.safetensors"
    state = load_file(file)
    state["backbone.model.norm.bias"] += 1e-3
    save_file(state, file)
    edit_config(tmp_path / "False", backbone_path=str(weights("vit_tiny16", seed=1)))
    for save_backbone in (True, False):
        with pytest.raises(ValueError, match="sha256"):
            FrozenViTChunkPolicy.from_pretrained(tmp_path / str(save_backbone))


def truncate(checkpoint: Path) -> None:
    file = checkpoint / "model.safetensors"
    file.write_bytes(file.read_bytes()[:-1000])


def drop_head(checkpoint: Path) -> None:
    state = load_file(checkpoint / "model.safetensors")
    del state["heads.gripper.bias"]
    save_file(state, checkpoint / "model.safetensors")


@pytest.mark.parametrize(
    ("damage", "error", "said"),
    [
        (truncate, ValueError, "damaged or truncated"),
        (lambda checkpoint: (checkpoint / "model.safetensors").write_bytes(b"x" * 99), ValueError, "damaged"),
        (
            lambda checkpoint: (checkpoint / "model.safetensors").unlink(),
            FileNotFoundError,
            "no weights file",
        ),
        (drop_head, ValueError, "does not fit its configuration.*heads.gripper.bias"),
        (
            lambda checkpoint: edit_config(checkpoint, chunk_size=4),
            ValueError,
            "does not fit its configuration",
        ),
    ],
)
def test_a_damaged_checkpoint_gets_one_sentence_that_names_the_file(damage, error, said, make_policy, tmp_path):
    make_policy(save_backbone=False).save_pretrained(tmp_path)
    damage(tmp_path)
    with pytest.raises(error, match=said) as refusal:
        FrozenViTChunkPolicy.from_pretrained(tmp_path)
    assert "model.safetensors" in str(refusal.value) and "\n" not in str(refusal.value)
    assert refusal.value.__cause__ is None


def test_a_random_backbone_that_is_drawn_otherwise_is_refused(make_policy, tmp_path):
    make_policy(save_backbone=False, backbone_pretrained=False, backbone_path=None).save_pretrained(tmp_path)
    FrozenViTChunkPolicy.from_pretrained(tmp_path)
    edit_json(tmp_path / "encoder.json", sha256="0" * 64)
    with pytest.raises(ValueError, match="asked for have sha256 000000000000.*versions of torch and timm"):
        FrozenViTChunkPolicy.from_pretrained(tmp_path)


@pytest.mark.parametrize("save_backbone", [True, False])
def test_a_hash_that_is_asked_for_is_the_checkpoints_own(save_backbone, make_policy, tmp_path):
    policy = make_policy(save_backbone=save_backbone)
    policy.save_pretrained(tmp_path)
    edit_config(tmp_path, backbone_sha256=policy.encoder_record.sha256)
    FrozenViTChunkPolicy.from_pretrained(tmp_path)
    edit_config(tmp_path, backbone_sha256="0" * 64)
    with pytest.raises(ValueError, match=r"trained with backbone_sha256=\w+, so it cannot have backbone_sha256=0000"):
        FrozenViTChunkPolicy.from_pretrained(tmp_path)


def test_a_checkpoint_travels_with_the_record_of_its_encoder(make_policy, tmp_path, monkeypatch):
    """By LeRobot's own push and load; the Hub is faked by a folder."""
    policy = make_policy(save_backbone=True)
    policy.config.repo_id = "somebody/policy"
    hub = tmp_path / "hub"

    def keep(api, folder_path, **_):
        shutil.copytree(folder_path, hub)
        return SimpleNamespace(repo_url=SimpleNamespace(url=""))

    def serve(repo_id, filename, **_):
        return str(hub / filename)

    monkeypatch.setattr(HfApi, "create_repo", lambda self, repo_id, **_: SimpleNamespace(repo_id=repo_id))
    monkeypatch.setattr(HfApi, "upload_folder", keep)
    monkeypatch.setattr(FrozenViTChunkPolicy, "generate_model_card", lambda *_, **__: ModelCard("---\n---\n"))
    dataset = SimpleNamespace(dataset=SimpleNamespace(repo_id="local/x"), save_pretrained=lambda folder: None)
    policy.push_model_to_hub(dataset)
    monkeypatch.setattr(modeling_frozen_vit, "hf_hub_download", serve)
    monkeypatch.setattr(pretrained, "hf_hub_download", serve)
    config = PreTrainedConfig.from_pretrained(hub)
    loaded = FrozenViTChunkPolicy.from_pretrained("somebody/policy", config=config)
    assert loaded.encoder_record == policy.encoder_record


@pytest.mark.parametrize("damage", [Path.unlink, lambda file: file.write_text('{"sha256": 1}')])
def test_a_checkpoint_without_the_record_of_its_encoder_is_one_sentence(damage, make_policy, tmp_path):
    make_policy().save_pretrained(tmp_path)
    damage(tmp_path / "encoder.json")
    with pytest.raises(UserError, match="encoder.json") as refusal:
        FrozenViTChunkPolicy.from_pretrained(tmp_path)
    assert "\n" not in str(refusal.value)


OTHERWISE = {
    "readout": "mean",
    "crop": (0.1, 0.1, 0.9, 0.9),
    "blind": True,
    "backbone": "vit_tiny16_augreg",
    "gripper_head": "regression",
    "action_scale": 0.01,
}


@pytest.mark.parametrize(("name", "value"), OTHERWISE.items())
def test_heads_are_not_shown_what_they_were_not_trained_on_nor_read_otherwise(name, value, make_policy, tmp_path):
    make_policy().save_pretrained(tmp_path)
    config = PreTrainedConfig.from_pretrained(tmp_path)
    setattr(config, name, value)
    with pytest.raises(ValueError, match=f"trained with {name}="):
        FrozenViTChunkPolicy.from_pretrained(tmp_path, config=config)


def test_lerobot_finds_policy_and_processors_by_their_names(make_policy, tmp_path):
    assert factory.get_policy_class("frozen_vit") is FrozenViTChunkPolicy
    config = FrozenViTChunkConfig(device="cpu")
    stats = {"observation.state": {"mean": torch.zeros(8), "std": torch.ones(8)}}
    for pipeline in factory.make_pre_post_processors(config, dataset_stats=stats):
        pipeline.save_pretrained(tmp_path)
    assert len(factory.make_pre_post_processors(config, pretrained_path=str(tmp_path))) == 2
