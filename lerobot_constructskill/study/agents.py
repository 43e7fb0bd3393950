"""What a rollout can drive an environment with: any LeRobot policy, many of which can share one encoder."""

import hashlib
from collections.abc import Callable, Mapping, Sequence
from contextlib import redirect_stdout
from dataclasses import dataclass, replace
from io import StringIO
from pathlib import Path
from typing import Any, Protocol

import numpy as np
import torch
from lerobot.configs import PreTrainedConfig
from lerobot.envs.utils import preprocess_observation
from lerobot.policies.factory import get_policy_class, make_pre_post_processors
from lerobot.policies.pretrained import PreTrainedPolicy

from lerobot_constructskill.parsing import as_input
from lerobot_constructskill.policies.frozen_vit.encoder import FrozenEncoder
from lerobot_constructskill.policies.frozen_vit.modeling_frozen_vit import POOLED, FrozenViTChunkPolicy


@dataclass(frozen=True)
class Observation:
    """What an environment shows of one step.

    Args:
        seen: the environment's observation.
        sim: privileged state, `contract.SIM_STATE` name to float32 array; for experts alone.
        instruction: the task's sentence.
        pooled: (1, ...) what the policy's readout takes of the encoded image, where the agent shares its encoder.
    """

    seen: dict[str, Any]
    sim: dict[str, np.ndarray]
    instruction: str
    pooled: torch.Tensor | None = None


class Agent(Protocol):
    """Something that acts in one environment."""

    encoder: FrozenEncoder | None
    """What turns its image into `Observation.pooled`, or None if it asks for none."""

    def reset(self, seed: int) -> None:
        """Forget the last episode; `seed` is that of the next one."""

    def act(self, observation: Observation) -> np.ndarray:
        """Return the action of this step, float32 (A,), in metres with the gripper last."""


class PolicyAgent:
    """A LeRobot policy between its two processors, as `lerobot-eval` runs it.

    Args:
        policy: the policy, in evaluation mode.
        preprocessor: from observations to what the policy reads.
        postprocessor: from the policy's output to actions.
    """

    def __init__(self, policy: PreTrainedPolicy, preprocessor, postprocessor):
        self.policy, self.preprocessor, self.postprocessor = policy.eval(), preprocessor, postprocessor
        self.encoder = policy.backbone if isinstance(policy, FrozenViTChunkPolicy) else None

    @classmethod
    def from_pretrained(
        cls, checkpoint: Path | str, device: str | None = None, backbone_precision: str | None = None
    ) -> "PolicyAgent":
        """Load a checkpoint folder, or a name on the Hub, of any registered policy type.

        Args:
            backbone_precision: of frozen_vit, in place of the one that the checkpoint was trained in.

        Raises:
            ValueError: its configuration cannot be read, or is of an unknown type.
            OSError: there is no such checkpoint.
        """
        with as_input():
            crossing = [f"--backbone_precision={backbone_precision}"] if backbone_precision else []
            config = PreTrainedConfig.from_pretrained(checkpoint, cli_overrides=crossing)
        config.device = device or config.device
        config.pretrained_path = checkpoint
        with redirect_stdout(StringIO()):  # LeRobot prints where it loads weights from, for every policy
            policy = get_policy_class(config.type).from_pretrained(checkpoint, config=config)
        on_device = {"device_processor": {"device": config.device}}
        processors = make_pre_post_processors(config, str(checkpoint), preprocessor_overrides=on_device)
        return cls(policy, *processors)

    @property
    def encoder_key(self) -> tuple:
        """Equal for agents whose encoders and readouts are the same."""
        config = self.policy.config
        crop = config.crop and tuple(config.crop)
        return config.readout, config.backbone, config.backbone_sha256, config.backbone_precision, crop, config.device

    def reset(self, seed: int) -> None:
        self.policy.reset()

    @torch.inference_mode()
    def act(self, observation: Observation) -> np.ndarray:
        batch = preprocess_observation(observation.seen) | {"task": [observation.instruction]}
        if observation.pooled is not None:
            del batch[self.policy.config.image_key]
            batch[POOLED] = observation.pooled
        action = self.postprocessor(self.policy.select_action(self.preprocessor(batch)))
        return action.squeeze(0).cpu().numpy()

    def image(self, observation: Observation) -> torch.Tensor:
        """What its encoder sees, (1, 3, H, W) in [0, 1]."""
        camera = self.policy.config.camera
        image = preprocess_observation({"pixels": {camera: observation.seen["pixels"][camera]}})
        return image[self.policy.config.image_key].to(self.policy.config.device)


class SharedEncoder:
    """One encoder for many agents, which encodes a batch of theirs at once and a frame that it has seen only once.

    With a fixed spawn a policy's episodes repeat frame for frame, and simulating a step costs less than encoding it.

    Args:
        policy: one of the policies that see with it.
        capacity: numbers remembered (1.6 GB): a million pooled features, or 4,000 frames' patch features.
    """

    def __init__(self, policy: FrozenViTChunkPolicy, capacity: int = 400_000_000):
        self.policy = policy
        self.capacity = capacity
        self._seen: dict[bytes, torch.Tensor] = {}

    @torch.inference_mode()
    def __call__(self, images: Sequence[torch.Tensor]) -> list[torch.Tensor]:
        """Encode (1, 3, H, W) images to the (1, ...) that the policies' readout takes of them."""
        keys = [hashlib.sha256(image.cpu().numpy()).digest() for image in images]
        new = {key: image for key, image in zip(keys, images, strict=True) if key not in self._seen}
        encoded = self._encode(list(new.values()))
        if new and (len(self._seen) + len(new)) * encoded[0].numel() > self.capacity:
            self._seen = {key: self._seen[key] for key in keys if key in self._seen}
        self._seen |= zip(new, encoded, strict=True)
        return [self._seen[key] for key in keys]

    def _encode(self, images: list[torch.Tensor]) -> Sequence[torch.Tensor]:
        if not images:
            return []
        if self.policy.backbone.runtime == "torch" and images[0].device.type == "cpu":
            return [self.policy.pool(image) for image in images]  # batches are no faster here, and round differently
        return self.policy.pool(torch.cat(images)).split(1)


def share_encoders(agents: Sequence[Agent]) -> dict[SharedEncoder, list[int]]:
    """Give agents whose encoders are the same one object; each such encoder with the numbers of its agents."""
    sharing: dict[tuple, list[int]] = {}
    for i, agent in enumerate(agents):
        if agent.encoder is not None:
            sharing.setdefault(agent.encoder_key, []).append(i)
    for numbers in sharing.values():
        for i in numbers:
            agents[i].encoder = agents[i].policy.backbone = agents[numbers[0]].encoder
    return {SharedEncoder(agents[numbers[0]].policy): numbers for numbers in sharing.values()}


def encode_together(
    agents: Sequence[Agent], encoders: Mapping[SharedEncoder, list[int]], observations: Mapping[int, Observation]
) -> dict[int, Observation | Exception]:
    """Give every observation, by its agent's number, what its readout takes: one batch for each encoder.

    In place of an observation without the image that its agent asks for stands the exception.
    """
    encoded: dict[int, Observation | Exception] = dict(observations)
    for encoder, sharing in encoders.items():
        images = {i: attempt(agents[i].image, observations[i]) for i in sharing if i in observations}
        encoded |= images
        images = {i: image for i, image in images.items() if not isinstance(image, Exception)}
        for i, pooled in zip(images, encoder(list(images.values())), strict=True):
            encoded[i] = replace(observations[i], pooled=pooled)
    return encoded


def attempt(call: Callable[..., Any], *args: Any) -> Any:
    """What a call returns, or the exception that it raises."""
    try:
        return call(*args)
    except Exception as error:
        return error
