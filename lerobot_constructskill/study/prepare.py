"""What a study stands on, made once and found again: demonstrations, and their features under every encoder."""

import fcntl
import hashlib
import json
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import torch
from lerobot.datasets import LeRobotDataset
from lerobot.utils.device_utils import auto_select_torch_device
from safetensors.torch import save_file
from torch import Tensor

from lerobot_constructskill.demos.recorder import record
from lerobot_constructskill.demos.settings import GenerateConfig, provenance
from lerobot_constructskill.errors import InputError, MissingError
from lerobot_constructskill.features.encode import PARTS, load_encoder, write_feature_set
from lerobot_constructskill.hashing import data_sha256
from lerobot_constructskill.parsing import parse
from lerobot_constructskill.policies.frozen_vit.backbones import IMAGE_SIZE, get_backbone
from lerobot_constructskill.policies.frozen_vit.encoder import FrozenEncoder
from lerobot_constructskill.policies.frozen_vit.precision import AUTO
from lerobot_constructskill.policies.frozen_vit.readouts import READOUTS
from lerobot_constructskill.staging import replaced, staged

GREY = 0.5
"""What a blind policy sees, in every pixel."""


class Store:
    """A folder of data sets, each under the hash of what it was made from, so that studies can share them.

    Args:
        root: the folder.
        workers: processes that generate demonstrations.
    """

    def __init__(self, root: Path, workers: int = 1):
        self.root = root
        self.workers = workers

    def demonstrations(self, config_file: str) -> LeRobotDataset:
        """The data set of a `constructskill-generate` configuration.

        Raises:
            FileNotFoundError: there is no such file.
            ValueError: it is not such a configuration, or too many attempts failed.
        """
        config, root = self._demonstrations_of(config_file)
        with self._alone(root):
            if not root.exists():
                record(replace(config, root=str(root), workers=self.workers))
        return LeRobotDataset(config.repo_id, root=root)

    def dataset_sha256(self, config_file: str) -> str | None:
        """Hash of the frames and videos of a configuration's data set, None while it has not been made."""
        try:
            _, root = self._demonstrations_of(config_file)
        except (OSError, InputError):
            return None
        return _cached_sha256(root) if root.exists() else None

    def _demonstrations_of(self, config_file: str) -> tuple[GenerateConfig, Path]:
        if not Path(config_file).is_file():
            raise MissingError(f"There is no constructskill-generate configuration '{config_file}'.")
        name = Path(config_file).stem
        config = parse(GenerateConfig, [f"--repo_id=local/{name}"], config_file)
        return config, self.root / f"{name}-{_digest(provenance(config))}"

    def features(self, demonstrations: LeRobotDataset, policy: dict[str, Any], blind: bool = False) -> LeRobotDataset:
        """The features of demonstrations under a `frozen_vit` policy's encoder; of a grey image if it is `blind`.

        Patch features, 0.2 MB a frame, are there where the policy's readout looks at them.

        Raises:
            FileNotFoundError: no source has the encoder's weights.
        """
        camera = policy.get("camera", "base")
        encoder, info = load_encoder(
            policy.get("backbone", "dinov2_vits14"),
            policy.get("backbone_path"),
            policy.get("backbone_trained_precision") or policy.get("backbone_precision", AUTO),
            policy.get("crop"),
            policy.get("device") or auto_select_torch_device(),
        )
        patches = READOUTS[policy.get("readout", "cls")].reads_patches
        made_of = {**info, "camera": camera, "blind": blind} | ({"patches": True} if patches else {})
        root = self.root / f"{demonstrations.root.name}-features-{_digest(made_of)}"
        repo_id = f"{demonstrations.repo_id}_{info['backbone']}"
        with self._alone(root):
            if not root.exists():
                eyes = Blindfolded(encoder) if blind else encoder
                with staged(root, keep=PARTS) as folder:
                    write_feature_set(demonstrations, camera, eyes, info, repo_id, folder, patches=patches)
        return LeRobotDataset(repo_id, root=root)

    def untrained_weights(self, backbone: str) -> Path:
        """Random weights of a backbone's architecture: what is its pretraining worth?"""
        path = self.root / f"untrained-{backbone}.safetensors"
        with self._alone(path):
            if not path.exists():
                with torch.random.fork_rng(devices=[]), replaced(path) as partial:
                    torch.manual_seed(0)
                    save_file(get_backbone(backbone).build().state_dict(), partial)
        return path

    @contextmanager
    def _alone(self, path: Path) -> Iterator[None]:
        """Wait until no other job, here or on a machine that shares the folder, makes `path`."""
        self.root.mkdir(parents=True, exist_ok=True)
        with (self.root / f".{path.name}.lock").open("w") as lock:
            fcntl.flock(lock, fcntl.LOCK_EX)
            yield


class Blindfolded:
    """An encoder that is shown a grey image, whatever there is to see."""

    def __init__(self, encoder: FrozenEncoder):
        self.spec, self.device = encoder.spec, encoder.device
        self.tokens = encoder.encode(torch.full((1, 3, IMAGE_SIZE, IMAGE_SIZE), GREY, device=encoder.device))

    def encode(self, images: Tensor) -> tuple[Tensor, Tensor]:
        """Return the grey image's tokens once for each of `images`, as `FrozenEncoder.encode` does."""
        return tuple(token.expand(len(images), *token.shape[1:]) for token in self.tokens)


_cached_sha256 = cache(data_sha256)
"""A finished data set does not change."""


def _digest(facts: dict[str, Any]) -> str:
    return hashlib.sha256(json.dumps(facts, sort_keys=True).encode()).hexdigest()[:8]
