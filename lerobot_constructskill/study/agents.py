"""What a rollout can drive an environment with: any LeRobot policy, many of which can share one encoder."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Protocol

import numpy as np
import torch
from lerobot.configs import PreTrainedConfig
from lerobot.envs.utils import preprocess_observation
from lerobot.policies.factory import get_policy_class, make_pre_post_processors
from lerobot.policies.pretrained import PreTrainedPolicy

from lerobot_constructskill.policies.frozen_vit.encoder import FrozenEncoder
from lerobot_constructskill.policies.frozen_vit.modeling_frozen_vit import FrozenViTChunkPolicy


@dataclass(frozen=True)
class Observation:
    """What an environment shows of one step.

    Args:
        seen: the environment's observation.
        sim: privileged state, `contract.SIM_STATE` name to float32 array; for experts alone.
        instruction: the task's sentence.
        feature: (1, D) the encoded image, where the agent shares its encoder.
    """

    seen: dict[str, Any]
    sim: dict[str, np.ndarray]
    instruction: str
    feature: torch.Tensor | None = None


class Agent(Protocol):
    """Something that acts in one environment."""

    encoder: FrozenEncoder | None
    """What turns its image into `Observation.feature`, or None if it asks for none."""

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
    def from_pretrained(cls, checkpoint: Path, device: str | None = None) -> "PolicyAgent":
        """Load a checkpoint folder of any registered policy type."""
        config = PreTrainedConfig.from_pretrained(checkpoint)
        config.device = device or config.device
        config.pretrained_path = checkpoint
        policy = get_policy_class(config.type).from_pretrained(checkpoint, config=config)
        on_device = {"device_processor": {"device": config.device}}
        processors = make_pre_post_processors(config, str(checkpoint), preprocessor_overrides=on_device)
        return cls(policy, *processors)

    def reset(self, seed: int) -> None:
        self.policy.reset()

    @torch.inference_mode()
    def act(self, observation: Observation) -> np.ndarray:
        batch = preprocess_observation(observation.seen) | {"task": [observation.instruction]}
        if observation.feature is not None:
            del batch[self.policy.config.image_key]
            batch[self.policy.config.feature_key] = observation.feature
        action = self.postprocessor(self.policy.select_action(self.preprocessor(batch)))
        return action.squeeze(0).cpu().numpy()

    def image(self, observation: Observation) -> torch.Tensor:
        """What its encoder sees, (1, 3, H, W) in [0, 1]."""
        camera = self.policy.config.camera
        image = preprocess_observation({"pixels": {camera: observation.seen["pixels"][camera]}})
        return image[self.policy.config.image_key].to(self.policy.config.device)


def share_encoders(agents: Sequence[Agent]) -> None:
    """Let agents whose encoders are the same use one object, which then encodes for all of them at once."""
    shared: dict[tuple, FrozenEncoder] = {}
    for agent in agents:
        if agent.encoder is not None:
            config = agent.policy.config
            key = (config.backbone, config.backbone_sha256, config.backbone_precision, config.device)
            agent.encoder = agent.policy.backbone = shared.setdefault(key, agent.encoder)


def encode_together(agents: Sequence[Agent], observations: Mapping[int, Observation]) -> dict[int, Observation]:
    """Give every observation its feature, one batch for each encoder: agent's number to observation."""
    encoded = dict(observations)
    for encoder in {id(a.encoder): a.encoder for a in agents if a.encoder is not None}.values():
        numbers = [i for i in observations if agents[i].encoder is encoder]
        images = [agents[i].image(observations[i]) for i in numbers]
        for i, feature in zip(numbers, _encode(encoder, images), strict=True):
            encoded[i] = replace(observations[i], feature=feature)
    return encoded


@torch.inference_mode()
def _encode(encoder: FrozenEncoder, images: Sequence[torch.Tensor]) -> Sequence[torch.Tensor]:
    """Encode (1, 3, H, W) images to (1, D) features, together where that is faster and gives the same."""
    if encoder.runtime == "torch" and images and images[0].device.type == "cpu":
        return [encoder(image) for image in images]  # batches are no faster here, and round differently
    return encoder(torch.cat(images)).split(1) if images else []
