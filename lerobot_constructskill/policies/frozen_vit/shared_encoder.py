"""Policies that share an encoder: frames of those that act together go through it together, and each only once."""

import hashlib
from collections.abc import Hashable, Mapping, Sequence
from itertools import batched

import torch
from lerobot.policies import PreTrainedPolicy
from torch import Tensor

from lerobot_constructskill.threads import one_thread

from .feature_sets import describe
from .readouts import beside

POOLED = "observation.pooled"
"""Entry of a batch beside the image: what `FrozenViTChunkPolicy.pool` returns for it."""

BATCH = 16
"""Frames that a GPU encodes at once. The last one is repeated where there are fewer."""


class SharedEncoders:
    """Encodes each image once for policies of which many share an encoder.

    Args:
        policies: of frozen_vit, by number. Those whose encoders are the same get one object.
    """

    def __init__(self, policies: Mapping[int, PreTrainedPolicy]):
        self._caches: dict[Hashable, FrameCache] = {}
        self._members: dict[int, FrameCache] = {}
        for number, policy in policies.items():
            self._members[number] = cache = self._caches.setdefault(_identity(policy), FrameCache(policy))
            policy.backbone = cache.policy.backbone

    def __call__(self, batches: Mapping[int, dict]) -> dict[int, dict | Exception]:
        """Return preprocessed batches of one frame each, by policy, with `POOLED` beside the images.

        A batch without an image stays as it is. An encoder that fails fails for the policies that share it, whose
        exception stands in place of their batches.
        """
        seen: dict[int, dict | Exception] = dict(batches)
        for cache in self._caches.values():
            keys = cache.policy.config.image_keys
            own = [number for number in batches if self._members[number] is cache]
            numbers = [number for number in own if all(key in batches[number] for key in keys)]
            try:
                each = [cache.pool([batches[number][key] for number in numbers]) for key in keys]
                with one_thread():
                    pooled = [beside(parts) for parts in zip(*each, strict=True)]
            except Exception as error:
                seen |= dict.fromkeys(numbers, error)
                continue
            for number, features in zip(numbers, pooled, strict=True):
                seen[number] = {**batches[number], POOLED: features}
        return seen


class FrameCache:
    """Remembers the features of every frame.

    At a fixed position a policy's episodes repeat frame for frame, and simulating a step costs less than encoding it.

    Args:
        policy: one of the policies that share the encoder.
        capacity: numbers remembered (1.6 GB): a million pooled features, or 4,000 frames' patch features.
    """

    def __init__(self, policy: PreTrainedPolicy, capacity: int = 400_000_000):
        self.policy = policy
        self.capacity = capacity
        self._seen: dict[bytes, Tensor] = {}

    @torch.inference_mode()
    def pool(self, images: Sequence[Tensor]) -> list[Tensor]:
        """Encode (1, 3, H, W) images to the (1, ...) that the policies' readout takes of them."""
        keys = [hashlib.sha256(image.cpu().numpy()).digest() for image in images]
        new = {key: image for key, image in zip(keys, images, strict=True) if key not in self._seen}
        encoded = self.encode(list(new.values())) if new else []
        if new and (len(self._seen) + len(new)) * encoded[0].numel() > self.capacity:
            self._seen = {key: self._seen[key] for key in keys if key in self._seen}
        self._seen |= zip(new, encoded, strict=True)
        return [self._seen[key] for key in keys]

    def encode(self, images: list[Tensor]) -> Sequence[Tensor]:
        """Encode one image or more, without the memory."""
        if images[0].device.type != "cpu":
            # A GPU's sums depend on the size of a batch, and how many frames are new on what runs beside.
            whole = [*images, *[images[-1]] * (-len(images) % BATCH)]
            pooled = [self.policy.pool(torch.cat(some)) for some in batched(whole, BATCH)]  # noqa: B911
            return torch.cat(pooled).split(1)[: len(images)]
        if self.policy.backbone.runtime == "torch":
            return [self.policy.pool(image) for image in images]  # batches are no faster here, and round differently
        with one_thread():
            return self.policy.pool(torch.cat(images)).split(1)


def _identity(policy: PreTrainedPolicy) -> Hashable:
    """Return a key that is equal for policies that compute the same from an image."""
    config, encoder = policy.config, policy.backbone
    described = describe(encoder.spec, policy.encoder_record.sha256, encoder.precision, encoder.crop, encoder.blind)
    return *described.values(), config.camera, config.readout, config.device
