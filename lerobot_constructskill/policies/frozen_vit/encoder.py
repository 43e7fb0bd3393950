"""Pixels in, one feature vector out: a backbone that never trains."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Literal

import torch
import torch.nn.functional as F  # noqa: N812
from torch import Tensor, nn

from lerobot_constructskill.files import Json
from lerobot_constructskill.threads import one_thread

from . import openvino
from .backbones import IMAGE_SIZE, Backbone
from .precision import computing_in, is_native

GREY = 0.5
"""Value of every pixel that a blind encoder sees."""

Crop = Sequence[float]
"""Left, top, right and bottom edge of the part of an image that is looked at, in shares of its width and height."""


@dataclass(frozen=True)
class EncoderRecord:
    """What a checkpoint says of its encoder, in `encoder.json` beside its weights. The policy writes it.

    Args:
        source: where the backbone's weights came from.
        sha256: hash of these weights. It is checked whenever the checkpoint is loaded.
        precision: number format of the features that the heads learned from.
        runtime: what computed these features, OpenVINO (on a CPU) or PyTorch; None where a feature set does not say.
        sentence_sha256: hash of the weights of the sentence encoder that the instructions went through; None without.
        sentence_dim: length of the vector that encodes an instruction; None where the policy is told none.
    """

    source: str | None = None
    sha256: str | None = None
    precision: Literal["float32", "bfloat16"] | None = None
    runtime: Literal["openvino", "torch"] | None = None
    sentence_sha256: str | None = None
    sentence_dim: int | None = None


RECORD_FILE = "encoder.json"
RECORD = Json("the record of a policy's encoder", EncoderRecord)


class FrozenEncoder(nn.Module):
    """A backbone without gradients, in evaluation mode whatever `train()` says.

    Args:
        backbone: the registry entry to build, with random weights until a state dict is loaded into `model`.
        precision: one of `precision.PRECISIONS` (features are float32 in either). OpenVINO computes it on a CPU
            that does it natively, where OpenVINO is installed; elsewhere PyTorch, bfloat16 by autocast. Autocast and
            TF32 that surround a call change nothing.
        crop: the part of every image that is encoded; None takes it all. The patches of a part are finer.
        blind: whether it sees a grey image in place of every other.
    """

    def __init__(self, backbone: Backbone, precision: str = "float32", crop: Crop | None = None, blind: bool = False):
        super().__init__()
        self.spec = backbone
        self.precision = precision
        self.crop = crop
        self.blind = blind
        # Heads drawn after this one must not depend on how many numbers a backbone's own initialisation took.
        with torch.random.fork_rng(devices=[]):
            self.model = backbone.build()
        self.requires_grad_(False)
        self.register_buffer("mean", torch.tensor(backbone.mean).view(1, 3, 1, 1), persistent=False)
        self.register_buffer("std", torch.tensor(backbone.std).view(1, 3, 1, 1), persistent=False)
        self._compiled: openvino.OpenVINOEncoder | None = None
        self.model.register_load_state_dict_post_hook(self._forget_compiled)  # a method, so that a copy has its own
        self.train(False)

    @property
    def device(self) -> torch.device:
        return self.mean.device

    @property
    def runtime(self) -> Literal["openvino", "torch"]:
        """What computes the features on this machine."""
        on_cpu = self.device.type == "cpu" and openvino.is_installed() and is_native(self.precision, self.device)
        return "openvino" if on_cpu else "torch"

    def train(self, mode: bool = True) -> "FrozenEncoder":
        return super().train(False)

    def forward(self, images: Tensor) -> Tensor:
        """Encode images.

        Args:
            images: (B, 3, H, W) float in [0, 1].

        Returns:
            (B, D) float32 pooled features.
        """
        return self.encode(images)[0]

    @torch.no_grad()
    def encode(self, images: Tensor) -> tuple[Tensor, Tensor]:
        """Return the pooled features (B, D) and the patch features (B, N, D) of images, float32."""
        pooled, patches = self._encode(torch.full_like(images[:1].float(), GREY) if self.blind else images)
        return pooled.expand(len(images), -1), patches.expand(len(images), -1, -1)

    def _encode(self, images: Tensor) -> tuple[Tensor, Tensor]:
        if self.runtime == "openvino":
            # OpenVINO cannot convert the casts of autocast. Torch's other threads would keep cores from it.
            with computing_in("float32", self.device), one_thread():
                return self._compile()(self.preprocess(images))
        with computing_in("float32", self.device):
            pixels = self.preprocess(images)
        with computing_in(self.precision, self.device):
            pooled, patches = self.spec.encode(self.model, pixels)
        return pooled.float(), patches.float()

    def _compile(self) -> openvino.OpenVINOEncoder:
        """Return the backbone compiled for this CPU, which is done once."""
        if self._compiled is None:
            self._compiled = openvino.OpenVINOEncoder(self.model, self.spec.encode, IMAGE_SIZE, self.precision)
        return self._compiled

    def preprocess(self, images: Tensor) -> Tensor:
        """Crop, resize to 224 x 224 where needed and apply the backbone's own pixel statistics."""
        images = images.float()
        if self.crop is not None:
            (height, width), (left, top, right, bottom) = images.shape[-2:], self.crop
            images = images[
                ..., round(top * height) : round(bottom * height), round(left * width) : round(right * width)
            ]
        if images.shape[-2:] != (IMAGE_SIZE, IMAGE_SIZE):
            images = F.interpolate(images, (IMAGE_SIZE, IMAGE_SIZE), mode="bicubic", antialias=True).clamp(0, 1)
        return (images - self.mean) / self.std

    def _forget_compiled(self, *_: Any) -> None:
        self._compiled = None

    def __getstate__(self) -> dict[str, Any]:
        return self.__dict__ | {"_compiled": None}  # for copies and other processes, which compile their own
