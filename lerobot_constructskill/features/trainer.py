"""How a study trains frozen_vit: demonstrations through the encoder once, then the heads on what came out."""

from collections.abc import Sequence
from dataclasses import replace
from itertools import product
from pathlib import Path

from lerobot.datasets import LeRobotDataset

from lerobot_constructskill.artifacts.store import Node
from lerobot_constructskill.errors import InputError
from lerobot_constructskill.features.node import PACKAGES, Features, JoinedFeatures
from lerobot_constructskill.policies.frozen_vit.backbones import get_backbone
from lerobot_constructskill.policies.frozen_vit.configuration_frozen_vit import FrozenViTChunkConfig
from lerobot_constructskill.policies.frozen_vit.feature_sets import close_patches
from lerobot_constructskill.policies.frozen_vit.language import language_sha256
from lerobot_constructskill.policies.frozen_vit.modeling_frozen_vit import FrozenViTChunkPolicy
from lerobot_constructskill.policies.frozen_vit.precision import AUTO, PRECISIONS, resolve_precision
from lerobot_constructskill.policies.frozen_vit.readouts import READOUTS
from lerobot_constructskill.policies.frozen_vit.train_seeds import save_checkpoint, train_seeds
from lerobot_constructskill.policies.frozen_vit.weights import find_sha256
from lerobot_constructskill.training.recipe import Training
from lerobot_constructskill.training.trainers import Trainer

STACK = 10
"""Seeds whose heads are trained as one computation: a step of all of them takes little longer than one of a seed."""


class FeatureTrainer(Trainer):
    """Trains frozen_vit's heads on features.

    Seeds are stacked unless the readout learns: each step then reads tens of megabytes a seed, and stacking only costs
    memory. Such seeds are trained side by side.
    """

    places = ("backbone_path",)
    packages = PACKAGES

    def settle(self, config: FrozenViTChunkConfig) -> list[FrozenViTChunkConfig]:
        """Resolve the precision `auto`, here and on other machines, and the hashes of weights (None without any).

        Raises:
            InputError: its heads are to begin as those of a checkpoint, or no source has weights of the hash it names.
        """
        if config.pretrained_path:
            raise InputError("A study trains frozen_vit's heads from the start; lerobot-train takes pretrained_path.")
        here = resolve_precision(config.backbone_precision, config.device)
        spec = get_backbone(config.backbone, config.backbone_path)
        sha256 = find_sha256(spec, config.backbone_path, config.backbone_pretrained, config.backbone_sha256)
        told = language_sha256(config.language, config.language_sha256)
        config = replace(config, backbone_sha256=sha256, language_sha256=told, save_backbone=False)
        precisions = [here, *PRECISIONS] if config.backbone_precision == AUTO else [here]
        return [
            replace(config, device=device, backbone_precision=one)
            for device, one in dict.fromkeys(product([config.device, "cpu"], precisions))
        ]

    def stack(self, config: FrozenViTChunkConfig) -> int:
        return 1 if READOUTS[config.readout].learns else STACK

    def is_single_threaded(self, config: FrozenViTChunkConfig) -> bool:
        return READOUTS[config.readout].learns and config.device == "cpu"

    def learns_from(self, config: FrozenViTChunkConfig, demonstrations: Node) -> Node:
        """The features of demonstrations; of a merged set, those of its parts, each of which is encoded once."""
        if parts := demonstrations.parts:
            return JoinedFeatures(config, demonstrations, tuple(Features(config, part) for part in parts))
        return Features(config, demonstrations)

    def fit(
        self,
        config: FrozenViTChunkConfig,
        dataset: LeRobotDataset,
        seeds: Sequence[int],
        training: Training,
        held_out: Sequence[int],
        folder: Path,
    ) -> dict[str, str]:
        policies = train_seeds(config, dataset, seeds, training.epochs, training.batch_size, held_out)
        for seed, policy in zip(seeds, policies, strict=True):
            save_checkpoint(policy, dataset, folder / f"seed_{seed}")
        close_patches()
        return {config.backbone: _backbone_line(policies[0])}


def _backbone_line(policy: FrozenViTChunkPolicy) -> str:
    """Describe the backbone, whose weights are not in the checkpoint."""
    record, precision = policy.encoder_record, policy.config.backbone_precision
    crossed = f", trained in {record.precision}" if record.precision != precision else ""
    return f"{record.source}, SHA-256 {record.sha256[:12]}, {precision}{crossed}"
