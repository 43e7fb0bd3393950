"""Pre- and post-processing of frozen_vit: LeRobot's default steps and nothing else."""

from typing import Any

import torch
from lerobot.processor import PolicyAction, PolicyProcessorPipeline, make_default_pre_post_processors

from .configuration_frozen_vit import FrozenViTChunkConfig


def make_frozen_vit_pre_post_processors(
    config: FrozenViTChunkConfig, dataset_stats: dict[str, dict[str, torch.Tensor]] | None = None
) -> tuple[
    PolicyProcessorPipeline[dict[str, Any], dict[str, Any]],
    PolicyProcessorPipeline[PolicyAction, PolicyAction],
]:
    """Make the two pipelines; only `observation.state` is normalised, images are inside the model."""
    return make_default_pre_post_processors(config, dataset_stats, normalizer_device=config.device)
