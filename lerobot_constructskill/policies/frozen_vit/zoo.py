"""Any model of timm or transformers as a backbone, described by its own configuration.

Its pixel statistics, token layout and pooled feature are the model's own; images are 224 x 224 as for every backbone.
Without a commit behind its name a model is what the Hub's `main` holds when it is first loaded: the sha256 that is
then recorded pins its weights from there on, and a commit also what it is and which pixels it takes.
"""

import os.path
import re
from collections.abc import Callable
from functools import cache, partial
from math import isqrt
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn

from lerobot_constructskill.errors import InputError, MissingWeightsError, first_line

from .backbone import IMAGE_SIZE, IMAGENET_MEAN, IMAGENET_STD, Backbone, without_loss
from .weights import hub_file

DESCRIPTIONS = ("config.json", "preprocessor_config.json")
"""What says which model of transformers lies in a folder, and which pixels it takes."""

Encode = Callable[[nn.Module, Tensor], tuple[Tensor, Tensor]]


@cache
def find(name: str, path: str | None = None) -> Backbone:
    """Return the backbone that a name says, such as `timm/resnet50.a1_in1k` or `hf/facebook/dinov2-base@<commit>`.

    Raises:
        ValueError: there is no such model, or its tokens are none that a policy can read.
        FileNotFoundError: no source has the configuration of an `hf/...` model.
    """
    library, _, rest = name.partition("/")
    model, _, revision = rest.partition("@")
    if library == "timm":
        return _from_timm(name, model, revision or "main")
    return _from_transformers(name, model, revision or "main", path)


def _from_timm(name: str, model: str, revision: str) -> Backbone:
    import timm

    try:
        facts = timm.get_pretrained_cfg(model) if timm.is_model(model) else None
    except RuntimeError:  # another tag of a model that it has
        facts = None
    if facts is None:
        raise InputError(f"timm has no model '{model}'; `timm.list_models()` lists its models.")
    build = partial(_build_timm, model)
    return Backbone(
        name=name,
        repo_id=facts.hf_hub_id,
        revision=revision,
        mean=tuple(facts.mean),
        std=tuple(facts.std),
        build=build,
        encode=_encode_timm,
        **_layout(name, _on_meta(build), _encode_timm),
    )


def _build_timm(model: str) -> nn.Module:
    import timm

    try:  # as large as it was trained, so that its own position embeddings are loaded and then resampled
        return timm.create_model(model, pretrained=False, num_classes=0, dynamic_img_size=True)
    except TypeError:  # it has none, or of one size alone
        return timm.create_model(model, pretrained=False, num_classes=0)


def _encode_timm(model: nn.Module, pixels: Tensor) -> tuple[Tensor, Tensor]:
    features = model.forward_features(pixels)
    pooled = model.forward_head(features, pre_logits=True)
    if features.ndim == 4:
        channels = 1 if features.shape[1] == model.num_features else 3
        return pooled, features.movedim(channels, -1).flatten(1, 2)
    return pooled, features[:, model.num_prefix_tokens :]


def _from_transformers(name: str, repo_id: str, revision: str, path: str | None) -> Backbone:
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
    model = _on_meta(build)
    return Backbone(
        name=name,
        repo_id=repo_id,
        revision=revision,
        mean=tuple(pixels.get("image_mean") or IMAGENET_MEAN),
        std=tuple(pixels.get("image_std") or IMAGENET_STD),
        build=build,
        encode=_encode_transformers,
        prefix=model.base_model_prefix + ".",
        **_layout(name, model, _encode_transformers),
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


def _build_transformers(config: Any) -> nn.Module:
    from transformers import AutoModel

    try:  # the pooler of a plain ViT was never trained, and its checkpoints are without
        model = AutoModel.from_config(config, add_pooling_layer=False)
    except TypeError:
        model = AutoModel.from_config(config)
    return without_loss(model)


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


def _layout(name: str, model: nn.Module, encode: Encode) -> dict[str, Any]:
    """How many patches a model has and how long a feature is; neither its weights nor the pixels have a content."""
    try:
        with torch.device("meta"):
            pooled, patches = encode(model, torch.empty(1, 3, IMAGE_SIZE, IMAGE_SIZE))
    except (RuntimeError, AssertionError, AttributeError, TypeError, ValueError) as error:
        said = first_line(error)
        raise InputError(f"{name} does not encode one image of {IMAGE_SIZE} x {IMAGE_SIZE} ({said}).") from None
    if pooled.shape[1:] != patches.shape[2:]:
        raise InputError(
            f"{name} pools {pooled.shape[-1]} numbers of patches of {patches.shape[-1]}; these must be equal."
        )
    if isqrt(patches.shape[1]) ** 2 != patches.shape[1]:
        raise InputError(f"{name} has {patches.shape[1]} patches, which are no square grid.")
    return {"feature_dim": pooled.shape[-1], "n_patches": patches.shape[1], "readout": "pooled_by_its_configuration"}


def _on_meta(build: Callable[[], nn.Module]) -> nn.Module:
    with torch.device("meta"):
        return build().eval()
