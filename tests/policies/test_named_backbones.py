"""Any model of timm or transformers, with random weights in the layout of the Hub, through the real loading code."""

import json
import logging

import pytest
import torch
from safetensors.torch import load_file, save_file
from transformers import (
    CLIPConfig,
    CLIPVisionConfig,
    Dinov2Config,
    ResNetConfig,
    SiglipVisionConfig,
    ViTConfig,
    ViTMAEConfig,
)

from lerobot_constructskill.features.encode import load_encoder
from lerobot_constructskill.policies.frozen_vit import backbones
from lerobot_constructskill.policies.frozen_vit.backbones import BACKBONES, check_backbone, get_backbone

TIMM = (
    "vit_tiny_patch16_224.augreg_in21k_ft_in1k",
    "resnet18.a1_in1k",
    "vit_small_patch14_reg4_dinov2.lvd142m",
    "convnextv2_atto.fcmae_ft_in1k",
    "swin_tiny_patch4_window7_224.ms_in1k",
)
SMALL = {"num_hidden_layers": 1, "hidden_size": 48, "num_attention_heads": 3, "intermediate_size": 64}
TRANSFORMERS = {
    "dinov2": Dinov2Config(**SMALL, patch_size=14, image_size=518),
    "vit": ViTConfig(**SMALL),
    "clip_vision": CLIPVisionConfig(**SMALL, patch_size=16),
    "clip": CLIPConfig(vision_config=CLIPVisionConfig(**SMALL, patch_size=16)),
    "siglip": SiglipVisionConfig(**SMALL),
    "resnet": ResNetConfig(hidden_sizes=[8, 8, 16, 16], depths=[1, 1, 1, 1], embedding_size=8),
}


def some(models, quick=2):
    """The first ones for `make test`, the others for `make nightly`."""
    return [pytest.param(name, marks=pytest.mark.nightly if i >= quick else ()) for i, name in enumerate(models)]


def describe(folder, config):
    config.save_pretrained(folder)
    pixels = {"image_processor_type": "ViTImageProcessor", "image_mean": [0.4] * 3, "image_std": [0.2] * 3}
    (folder / "preprocessor_config.json").write_text(json.dumps(pixels))


def check_it_encodes(name, folder, images, statistics):
    spec = get_backbone(name, str(folder))
    with torch.random.fork_rng():
        torch.manual_seed(0)
        state = spec.build().state_dict()
    save_file({spec.prefix + key: value.contiguous() for key, value in state.items()}, folder / "model.safetensors")
    encoder, info = load_encoder(name, str(folder), "float32")
    pooled, patches = encoder.encode(images)
    assert pooled.shape == (2, spec.feature_dim) and patches.shape == (2, spec.n_patches, spec.feature_dim)
    assert torch.isfinite(pooled).all() and pooled.std() > 0
    assert (spec.mean, spec.std) == statistics and info["backbone"] == name
    return spec


@pytest.mark.slow
@pytest.mark.parametrize("model", some(TIMM))
def test_a_model_of_timm_encodes_as_its_configuration_says(model, tmp_path, images):
    import timm

    facts = timm.get_pretrained_cfg(model)
    spec = check_it_encodes(f"timm/{model}@0123abc", tmp_path, images, (facts.mean, facts.std))
    assert (spec.repo_id, spec.revision) == (f"timm/{model}", "0123abc")


@pytest.mark.slow
@pytest.mark.parametrize("kind", some(TRANSFORMERS))
def test_a_model_of_transformers_encodes_as_its_folder_says(kind, tmp_path, images):
    describe(tmp_path, TRANSFORMERS[kind])
    spec = check_it_encodes("hf/somebody/model", tmp_path, images, ((0.4,) * 3, (0.2,) * 3))
    assert (spec.repo_id, spec.revision) == ("somebody/model", "main")


@pytest.mark.slow
@pytest.mark.parametrize(
    ("named", "entry"),
    [
        ("timm/vit_tiny_patch16_224.augreg_in21k_ft_in1k", "vit_tiny16_augreg"),
        ("hf/facebook/dinov2-small", "dinov2_vits14"),
    ],
)
def test_what_is_an_entry_too_gives_the_entrys_features(named, entry, weights, images, tmp_path):
    folder = weights(entry)
    if named.startswith("hf/"):
        describe(tmp_path, BACKBONES[entry].build().config)
        mean, std = BACKBONES[entry].mean, BACKBONES[entry].std
        (tmp_path / "preprocessor_config.json").write_text(json.dumps({"image_mean": mean, "image_std": std}))
        save_file(load_file(folder / "model.safetensors"), tmp_path / "model.safetensors")
        folder = tmp_path
    ours, theirs = (load_encoder(name, str(folder), "float32")[0].encode(images) for name in (entry, named))
    assert all(torch.equal(a, b) for a, b in zip(ours, theirs, strict=True))


@pytest.mark.parametrize(
    "name", ["", "resnet50", "timm/", "hf/model", "timm/../x", "hf/a/b/c", "timm/a b", "dinov2_vits14@1"]
)
def test_a_name_that_nothing_can_have_is_refused_before_anything_is_looked_for(name):
    with pytest.raises(ValueError, match="the backbones are: .*timm/<model>"):
        check_backbone(name)


def test_what_cannot_be_had_is_one_sentence(tmp_path, monkeypatch, caplog):
    monkeypatch.setattr(backbones, "hub_file", lambda *_: None)  # stands in for a machine that does not reach the Hub
    caplog.set_level(logging.INFO)
    (tmp_path / "config.json").write_text("{}")
    (tmp_path / "preprocessor_config.json").write_text("{}")
    describe(tmp_path / "masked", ViTMAEConfig(**SMALL))
    describe(tmp_path / "larger", ViTConfig(**SMALL, image_size=384))
    for name, path, error, said in (
        ("timm/nothing_of_the_kind", None, ValueError, "timm has no model 'nothing_of_the_kind'"),
        ("timm/resnet18.another_tag", None, ValueError, "timm has no model 'resnet18.another_tag'"),
        ("timm/mobilenetv3_large_100", None, ValueError, "pools 1280 numbers of patches of 960"),
        ("hf/somebody/model", None, FileNotFoundError, r"has no config.json.*hf download somebody/model"),
        ("hf/somebody/model", tmp_path, ValueError, "describes no model that transformers knows"),
        ("hf/somebody/model", tmp_path / "masked", ValueError, "encodes a random part of every image"),
        ("hf/somebody/model", tmp_path / "larger", ValueError, r"does not encode one image of 224 x 224 \(Input"),
    ):
        with pytest.raises(error, match=said) as refusal:
            get_backbone(name, path and str(path))
        assert "\n" not in str(refusal.value)
