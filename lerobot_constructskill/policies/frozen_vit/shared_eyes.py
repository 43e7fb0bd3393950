"""Many policies that see alike: one encoder for all of them, one batch for each step, and each frame only once."""

import hashlib
from collections.abc import Hashable, Mapping, Sequence
from itertools import batched

import torch
from lerobot.policies import PreTrainedPolicy
from torch import Tensor

POOLED = "observation.pooled"
"""What `FrozenViTChunkPolicy.pool` returns for the image, in place of it in a batch."""

type Batches = Mapping[int, dict]
"""Preprocessed batches of one frame each, by their policy's number."""

type Seen = dict[int, dict | Exception]
"""The same with what an encoder made of the image, or with the exception that it raised."""

BATCH = 16
"""Frames that a GPU encodes at once; of fewer the last is repeated."""


class SharedEyes:
    """Puts what their readouts take of an image in place of the image, for policies of which many may see alike.

    Args:
        policies: of frozen_vit, by number. Those whose encoders are the same get one object.
    """

    def __init__(self, policies: Mapping[int, PreTrainedPolicy]):
        self._groups: dict[Hashable, _Memory] = {}
        self._members: dict[int, Hashable] = {}
        for number, policy in policies.items():
            key = _eyes(policy)
            memory = self._groups.setdefault(key, _Memory(policy))
            policy.backbone = memory.policy.backbone
            self._members[number] = key

    def __call__(self, batches: Batches) -> Seen:
        """Return the batches, each with `POOLED`; a batch without the image stays as it is.

        An encoder that fails fails for the policies that share it, whose exception stands in place of their batches.
        """
        seen: Seen = dict(batches)
        for key, memory in self._groups.items():
            image_key = memory.policy.config.image_key
            numbers = [number for number in batches if self._members[number] == key and image_key in batches[number]]
            try:
                pooled = memory.pool([batches[number][image_key] for number in numbers])
            except Exception as error:
                seen |= dict.fromkeys(numbers, error)
                continue
            for number, of_image in zip(numbers, pooled, strict=True):
                rest = {name: value for name, value in batches[number].items() if name != image_key}
                seen[number] = rest | {POOLED: of_image}
        return seen


class _Memory:
    """One encoder, and what it made of the frames that it has seen.

    At a fixed position a policy's episodes repeat frame for frame, and simulating a step costs less than encoding it.

    Args:
        policy: one of the policies that see with it.
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
        encoded = self._encode(list(new.values()))
        if new and (len(self._seen) + len(new)) * encoded[0].numel() > self.capacity:
            self._seen = {key: self._seen[key] for key in keys if key in self._seen}
        self._seen |= zip(new, encoded, strict=True)
        return [self._seen[key] for key in keys]

    def _encode(self, images: list[Tensor]) -> Sequence[Tensor]:
        if not images:
            return []
        if images[0].device.type != "cpu":
            # A GPU's sums depend on the size of a batch, and how many frames are new on what runs beside.
            whole = [*images, *[images[-1]] * (-len(images) % BATCH)]
            pooled = [self.policy.pool(torch.cat(some)) for some in batched(whole, BATCH)]  # noqa: B911
            return torch.cat(pooled).split(1)[: len(images)]
        if self.policy.backbone.runtime == "torch":
            return [self.policy.pool(image) for image in images]  # batches are no faster here, and round differently
        return self.policy.pool(torch.cat(images)).split(1)


def _eyes(policy: PreTrainedPolicy) -> Hashable:
    """Equal for policies that take the same of an image."""
    config = policy.config
    encoder = config.backbone, config.backbone_sha256, config.backbone_precision, config.blind
    return *encoder, config.crop and tuple(config.crop), config.camera, config.readout, config.device
