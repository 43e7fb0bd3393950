"""Writes a feature set: a LeRobotDataset through a frozen encoder, once."""

import hashlib
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pandas as pd
import torch
from lerobot.datasets import LeRobotDataset
from lerobot.datasets.compute_stats import compute_episode_stats
from lerobot.datasets.dataset_tools import modify_features
from lerobot.datasets.io_utils import write_stats
from lerobot.datasets.video_utils import decode_video_frames
from lerobot.utils.constants import DEFAULT_FEATURES
from torch import Tensor
from tqdm import tqdm

from lerobot_constructskill.policies.frozen_vit.backbones import get_backbone
from lerobot_constructskill.policies.frozen_vit.encoder import PRECISIONS, FrozenEncoder
from lerobot_constructskill.policies.frozen_vit.features import describe, feature_key
from lerobot_constructskill.policies.frozen_vit.weights import load_weights, state_sha256

PATCHES = "patch_features.npy"
"""Memory map of the patch features in the root of a feature set: (N, P, D) float16, row i that of `index` i."""


def load_encoder(
    backbone: str, path: str | None = None, precision: str = "float32"
) -> tuple[FrozenEncoder, dict[str, str]]:
    """Return an encoder with its weights, and the description that its features carry.

    Raises:
        ValueError: unknown backbone or precision, or damaged weights.
        FileNotFoundError: no source has the weights.
    """
    spec = get_backbone(backbone)
    if precision not in PRECISIONS:
        raise ValueError(f"backbone_precision must be one of {', '.join(PRECISIONS)}, got '{precision}'.")
    state, source = load_weights(spec, path)
    encoder = FrozenEncoder(spec, precision)
    encoder.model.load_state_dict(state)
    made = {"weights_source": source, "runtime": encoder.runtime}
    return encoder, {**describe(spec, state_sha256(state), precision), **made}


def encode_frames(
    dataset: LeRobotDataset, camera: str, encoder: FrozenEncoder, batch_size: int, patches: Path | None = None
) -> np.ndarray:
    """Encode every frame of one camera, in the order of the data set.

    Args:
        patches: file to write the patch features to as well, a NumPy array (N, P, D) float16.

    Returns:
        (N, D) float32

    Raises:
        ValueError: the data set has no such camera.
    """
    key = f"observation.images.{camera}"
    if key not in dataset.meta.camera_keys:
        cameras = ", ".join(dataset.meta.camera_keys) or "none"
        raise ValueError(f"The data set '{dataset.repo_id}' has no {key}; its cameras are: {cameras}.")
    device = next(encoder.parameters()).device
    spec, n_frames = encoder.spec, dataset.num_frames
    features = np.empty((n_frames, spec.feature_dim), dtype=np.float32)
    if patches is not None:
        shape = (n_frames, spec.n_patches, spec.feature_dim)
        patch_map = np.lib.format.open_memmap(patches, "w+", dtype=np.float16, shape=shape)
    done = 0
    with tqdm(total=n_frames, unit="frame", desc=f"Encoding {camera}") as progress:
        for images in _batches(dataset, key, batch_size):
            rows = slice(done, done + len(images))
            pooled, tokens = encoder.encode(images.to(device) / 255)
            features[rows] = pooled.cpu().numpy()
            if patches is not None:
                patch_map[rows] = tokens.cpu().numpy()
            done = rows.stop
            progress.update(len(images))
    return features


def write_feature_set(
    dataset: LeRobotDataset, camera: str, features: np.ndarray, info: dict[str, str], repo_id: str, folder: Path
) -> None:
    """Write a copy of `dataset` with `features` (N, D) in place of its images.

    Indices, episodes, tasks, actions and other observations stay as they are; columns that no policy reads are left
    out, because LeRobot's loader takes time for each.
    """
    key = feature_key(camera)
    info = {**info, "source_repo_id": dataset.repo_id, "source_sha256": data_sha256(dataset.root)}
    column = {"dtype": "float32", "shape": (features.shape[1],), "names": None, "info": info}
    copy = modify_features(dataset, {key: (features, column)}, _left_out(dataset), folder, repo_id)
    stats = compute_episode_stats({key: features}, {key: column})
    write_stats({**(copy.meta.stats or {}), **stats}, folder)
    _forget_videos(folder)


def _left_out(dataset: LeRobotDataset) -> list[str]:
    read = [name for name in dataset.meta.features if name.startswith(("observation.", "action"))]
    kept = set(read) - set(dataset.meta.camera_keys) | set(DEFAULT_FEATURES)
    return [name for name in dataset.meta.features if name not in kept]


def data_sha256(root: Path) -> str:
    """Hash the frames and videos of a data set: relative paths and bytes, in the order of the paths."""
    digest = hashlib.sha256()
    for path in sorted(p for folder in ("data", "videos") for p in (root / folder).rglob("*") if p.is_file()):
        digest.update(path.relative_to(root).as_posix().encode())
        with path.open("rb") as file:
            digest.update(hashlib.file_digest(file, "sha256").digest())
    return digest.hexdigest()


def _batches(dataset: LeRobotDataset, key: str, batch_size: int) -> Iterator[Tensor]:
    """Yield (B, 3, H, W) images in [0, 255], episode by episode, so that a video is decoded front to back."""
    for episode in dataset.meta.episodes:
        start, stop = episode["dataset_from_index"], episode["dataset_to_index"]
        for first in range(start, stop, batch_size):
            rows = range(first, min(first + batch_size, stop))
            if key in dataset.meta.video_keys:
                offset = episode[f"videos/{key}/from_timestamp"]
                times = [offset + (row - start) / dataset.fps for row in rows]
                path = dataset.root / dataset.meta.get_video_file_path(episode["episode_index"], key)
                yield decode_video_frames(path, times, dataset.tolerance_s, return_uint8=True)
            else:
                yield torch.stack(dataset.hf_dataset[list(rows)][key]) * 255


def _forget_videos(root: Path) -> None:
    """Drop what the copied episode tables still say about videos that the copy does not have."""
    for path in (root / "meta" / "episodes").rglob("*.parquet"):
        table = pd.read_parquet(path)
        gone = [name for name in table if name.startswith(("videos/", "stats/observation.images."))]
        table.drop(columns=gone).to_parquet(path, index=False)
