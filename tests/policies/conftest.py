"""Backbones with random weights: the real architectures, loaded from files through the real local path."""

from collections.abc import Callable
from pathlib import Path

import pytest
import torch
from lerobot.configs import FeatureType, PolicyFeature
from random_features import config, feature_set, other_set, tiny_weights, told_set  # noqa: F401
from safetensors.torch import save_file
from torch import Tensor

from lerobot_constructskill.policies.frozen_vit.backbones import BACKBONES
from lerobot_constructskill.policies.frozen_vit.configuration_frozen_vit import FrozenViTChunkConfig
from lerobot_constructskill.policies.frozen_vit.modeling_frozen_vit import FrozenViTChunkPolicy
from lerobot_constructskill.policies.frozen_vit.readouts import POINT_NAMES
from lerobot_constructskill.policies.frozen_vit.shared_encoder import POOLED

TINY = "vit_tiny16"

MakePolicy = Callable[..., FrozenViTChunkPolicy]
Batch = dict[str, Tensor]


@pytest.fixture(scope="session")
def weights(tmp_path_factory: pytest.TempPathFactory) -> Callable[..., Path]:
    """A folder in the Hub's layout with random weights of a backbone; another `seed` gives other weights."""
    written: dict[tuple, Path] = {}

    def write(name: str, seed: int = 0) -> Path:
        key = (BACKBONES[name].repo_id or name, seed)
        if key not in written:
            written[key] = tmp_path_factory.mktemp(name)
            with torch.random.fork_rng():
                torch.manual_seed(seed)
                state = BACKBONES[name].build().state_dict()
            save_file({BACKBONES[name].prefix + k: v for k, v in state.items()}, written[key] / "model.safetensors")
        return written[key]

    return write


@pytest.fixture
def make_policy(weights: Callable[..., Path]) -> MakePolicy:
    """Make a policy on a random tiny backbone; keywords are configuration fields."""

    def make(
        camera_shape: tuple[int, ...] = (3, 224, 224), dataset_stats: dict | None = None, **fields
    ) -> FrozenViTChunkPolicy:
        backbone = fields.setdefault("backbone", TINY)
        fields.setdefault("backbone_path", str(weights(backbone)))
        filled = FrozenViTChunkConfig(device="cpu", **fields)
        filled.input_features = {
            "observation.images.base": PolicyFeature(FeatureType.VISUAL, camera_shape),
            "observation.state": PolicyFeature(FeatureType.STATE, (8,)),
        }
        torch.manual_seed(0)
        return FrozenViTChunkPolicy(filled, dataset_stats=dataset_stats)

    return make


@pytest.fixture
def make_batch() -> Callable[..., Batch]:
    """Make a batch of what the readout takes, states and chunks; the last two steps of sample 0 are padded."""

    def make(policy: FrozenViTChunkPolicy, size: int = 4, seed: int = 0) -> Batch:
        rng = torch.Generator().manual_seed(seed)
        steps, channels = policy.config.chunk_size, len(policy.config.action_names)
        action = torch.rand(size, steps, channels, generator=rng) * 0.1 - 0.05
        action[..., -1] = torch.where(action[..., 0] > 0, 1.0, -1.0)
        padded = torch.zeros(size, steps, dtype=torch.bool)
        padded[0, -2:] = steps > 2
        spec = policy.backbone.spec
        tokens = torch.randn(size, 1 + spec.n_patches, spec.feature_dim, generator=rng)
        return {
            POOLED: policy.readout.pool(tokens[:, 0], tokens[:, 1:]),
            "observation.state": torch.randn(size, 8, generator=rng),
            "action": action,
            "action_is_pad": padded,
            "observation.points.base": torch.rand(size, len(POINT_NAMES), generator=rng) * 2 - 1,
        }

    return make


@pytest.fixture
def images() -> Tensor:
    return torch.rand(2, 3, 224, 224, generator=torch.Generator().manual_seed(0))
