"""Pixels in, one feature vector out: a backbone that never trains."""

import torch
import torch.nn.functional as F  # noqa: N812
from torch import Tensor, nn

from .backbones import IMAGE_SIZE, Backbone

PRECISIONS = ("float32", "bfloat16")


class FrozenEncoder(nn.Module):
    """A backbone without gradients, in evaluation mode whatever `train()` says.

    Args:
        backbone: the registry entry to build, with random weights until a state dict is loaded into `model`.
        precision: "float32", or "bfloat16" to run the backbone under autocast (features stay float32).
    """

    def __init__(self, backbone: Backbone, precision: str = "float32"):
        super().__init__()
        self.spec = backbone
        self.precision = precision
        # Heads drawn after this one must not depend on how many numbers a backbone's own initialisation took.
        with torch.random.fork_rng(devices=[]):
            self.model = backbone.build()
        self.requires_grad_(False)
        self.register_buffer("mean", torch.tensor(backbone.mean).view(1, 3, 1, 1), persistent=False)
        self.register_buffer("std", torch.tensor(backbone.std).view(1, 3, 1, 1), persistent=False)
        self.train(False)

    def train(self, mode: bool = True) -> "FrozenEncoder":
        return super().train(False)

    @torch.no_grad()
    def forward(self, images: Tensor) -> Tensor:
        """Encode images.

        Args:
            images: (B, 3, H, W) float in [0, 1].

        Returns:
            (B, D) float32 pooled features.
        """
        pixels = self.preprocess(images)
        low = self.precision == "bfloat16"
        with torch.autocast(pixels.device.type, dtype=torch.bfloat16, enabled=low):
            return self.spec.pool(self.model, pixels).float()

    def preprocess(self, images: Tensor) -> Tensor:
        """Resize to 224 x 224 where needed and apply the backbone's own pixel statistics."""
        images = images.float()
        if images.shape[-2:] != (IMAGE_SIZE, IMAGE_SIZE):
            size = (IMAGE_SIZE, IMAGE_SIZE)
            images = F.interpolate(images, size=size, mode="bicubic", antialias=True).clamp(0, 1)
        return (images - self.mean) / self.std
