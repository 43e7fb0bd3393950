"""Writes a feature set: a LeRobotDataset through a frozen encoder, once."""

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from lerobot.datasets import LeRobotDataset, modify_features, write_stats
from lerobot.utils import DEFAULT_FEATURES
from torch import Tensor

from lerobot_constructskill.artifacts.digests import data_sha256, digest
from lerobot_constructskill.artifacts.folders import replaced
from lerobot_constructskill.errors import InputError
from lerobot_constructskill.features.points import POSES, find_points
from lerobot_constructskill.files import read_parquet
from lerobot_constructskill.lerobot_internals import compute_episode_stats, decode_video_frames
from lerobot_constructskill.policies.frozen_vit.backbones import get_backbone
from lerobot_constructskill.policies.frozen_vit.encoder import Crop, FrozenEncoder
from lerobot_constructskill.policies.frozen_vit.features import (
    PATCHES_FILE,
    bind_patches,
    describe,
    feature_key,
    point_key,
)
from lerobot_constructskill.policies.frozen_vit.precision import AUTO, check_native, resolve_precision
from lerobot_constructskill.policies.frozen_vit.readouts import POINT_NAMES
from lerobot_constructskill.policies.frozen_vit.weights import load_weights, state_sha256
from lerobot_constructskill.progress import Progress, quiet

PARTS = "encoded"
"""Folder for finished episodes, beside the feature set in the making."""

PATCHES = ".patches.npy"

BATCH, BATCHES = 16, {"cuda": 256}
"""Images that are encoded at a time by default, and by kinds of devices on which more are faster. On those the last
bits of a feature depend on the batch, so the description of the features names its size."""


def load_encoder(
    backbone: str,
    path: str | None = None,
    precision: str = AUTO,
    crop: Crop | None = None,
    device: torch.device | str = "cpu",
    pretrained: bool = True,
    blind: bool = False,
    sha256: str | None = None,
) -> tuple[FrozenEncoder, dict[str, str]]:
    """Return an encoder with its weights on a device, and the description that its features carry.

    Raises:
        ValueError: unknown backbone, damaged weights, or a precision that is unknown or not native to the device.
        FileNotFoundError: no source has the weights.
    """
    spec = get_backbone(backbone, path)
    precision = resolve_precision(precision, device)
    check_native(precision, device)
    state, source = load_weights(spec, path, sha256, pretrained)
    encoder = FrozenEncoder(spec, precision, crop, blind)
    encoder.model.load_state_dict(state)
    encoder.to(device)
    made = {"weights_source": source, "runtime": encoder.runtime}
    return encoder, {**describe(spec, state_sha256(state), precision, crop, blind), **made}


def batch_facts(device: torch.device | str, batch_size: int | None = None) -> dict[str, str]:
    """What the description of features says of their batch: its size, on a device of `BATCHES`."""
    kind = torch.device(device).type
    return {"batch_size": str(batch_size or BATCHES[kind])} if kind in BATCHES else {}


def write_feature_set(
    dataset: LeRobotDataset,
    camera: str,
    encoder: FrozenEncoder,
    info: dict[str, str],
    repo_id: str,
    folder: Path,
    batch_size: int | None = None,
    patches: bool = False,
    points: bool = False,
) -> None:
    """Write a copy of `dataset` with the pooled features of one camera, (N, D) float32, in place of its images.

    Indices, episodes, tasks, actions and other observations stay as they are; columns that no policy reads are left
    out, because LeRobot's loader takes time for each.

    Args:
        encoder: what encodes, and with `info` its description, as `load_encoder` returns them.
        folder: where to, a path that `staged` gave; episodes that a killed run finished are not encoded again.
        batch_size: images at a time; that of the encoder's device by default.
        patches: whether to write every patch's feature as well, to `PATCHES_FILE`.
        points: whether to write as well where in the image the points of `readouts.POINTS` are.

    Raises:
        ValueError: the data set has no such camera, or does not say where things are.
    """
    batch_size = batch_size or BATCHES.get(encoder.device.type, BATCH)
    info = _with_source(info, dataset) | batch_facts(encoder.device, batch_size)
    made_of = {**info, "camera": camera, "patches": patches}
    parts = _parts_folder(folder, made_of)
    found = _find_points(dataset, camera, encoder.crop) if points else {}
    features = _encode_frames(dataset, camera, encoder, batch_size, parts, patches)
    _write_copy(dataset, camera, features, info, repo_id, folder, found)
    if patches:
        of_episodes = [_part(parts, episode).with_suffix(PATCHES) for episode in dataset.meta.episodes]
        _join_files(of_episodes, dataset.num_frames, folder / PATCHES_FILE)
        bind_patches(folder)


def join_feature_sets(
    dataset: LeRobotDataset,
    camera: str,
    parts: Sequence[LeRobotDataset],
    info: dict[str, str],
    repo_id: str,
    folder: Path,
    patches: bool = False,
    points: bool = False,
) -> None:
    """Write what `write_feature_set` would, from the feature sets of the parts that `dataset` was merged of, in order.

    Raises:
        ValueError: the parts have other numbers of frames.
    """
    key = feature_key(camera)
    pooled = [_column(part, key) for part in parts]
    name = point_key(camera)
    found = {name: np.concatenate([_column(part, name) for part in parts])} if points else {}
    if sum(map(len, pooled)) != dataset.num_frames:
        raise InputError(f"The parts of '{dataset.repo_id}' do not add up to its {dataset.num_frames} frames.")
    _write_copy(dataset, camera, np.concatenate(pooled), _with_source(info, dataset), repo_id, folder, found)
    if patches:
        _join_files([part.root / PATCHES_FILE for part in parts], dataset.num_frames, folder / PATCHES_FILE)
        bind_patches(folder)


def _column(dataset: LeRobotDataset, name: str) -> np.ndarray:
    return np.stack(dataset.hf_dataset.with_format("numpy")[name][:])


def _find_points(dataset: LeRobotDataset, camera: str, crop: Crop | None) -> dict[str, np.ndarray]:
    """The column of points, by its name."""
    known = {name: _column(dataset, name) for name in POSES.values() if name in dataset.meta.features}
    return {point_key(camera): find_points(known, camera, crop)}


def _join_files(files: Sequence[Path], frames: int, joined: Path) -> None:
    """Write the rows of several files of patch features, one open at a time, into one of so many frames."""
    shape = (frames, *np.load(files[0], mmap_mode="r").shape[1:])
    header = {"descr": np.lib.format.dtype_to_descr(np.dtype(np.float16)), "fortran_order": False, "shape": shape}
    with joined.open("wb") as out:  # a full disk raises here; under a memory map it would kill the process
        np.lib.format.write_array_header_1_0(out, header)
        for file in files:
            out.write(np.load(file, mmap_mode="r"))


def _with_source(info: dict[str, str], dataset: LeRobotDataset) -> dict[str, str]:
    return {**info, "source_repo_id": dataset.repo_id, "source_sha256": data_sha256(dataset.root)}


def _encode_frames(
    dataset: LeRobotDataset, camera: str, encoder: FrozenEncoder, batch_size: int, parts: Path, patches: bool
) -> np.ndarray:
    """Encode every frame of one camera to (N, D) float32, in the order of the data set, by way of `parts`."""
    key = f"observation.images.{camera}"
    if key not in dataset.meta.camera_keys:
        cameras = ", ".join(dataset.meta.camera_keys) or "none"
        raise InputError(f"The data set '{dataset.repo_id}' has no {key}; its cameras are: {cameras}.")
    missing = [episode for episode in dataset.meta.episodes if not _part(parts, episode).exists()]
    finished = dataset.num_frames - sum(episode["length"] for episode in missing)
    # Frames of an earlier run are where the bar starts, not part of its rate.
    with Progress(total=dataset.num_frames, initial=finished, unit="frame", desc=f"Encoding {camera}") as progress:
        for episode in missing:
            batches = []
            for images in _batches(dataset, key, episode, batch_size):
                batches.append(_encode(encoder, images, patches))
                progress.update(len(images))
            pooled, tokens = zip(*batches, strict=True)
            file = _part(parts, episode)
            if patches:
                _save(file.with_suffix(PATCHES), np.concatenate(tokens))
            _save(file, np.concatenate(pooled))  # last: it says that the episode is finished
    return np.concatenate([np.load(_part(parts, episode)) for episode in dataset.meta.episodes])


def _parts_folder(folder: Path, made_of: dict[str, Any]) -> Path:
    """Where the finished episodes of a feature set lie that is being written to `folder`.

    Nothing that was made otherwise is ever taken for a part: what they are made of is in the folder's name.
    """
    return folder.with_name(PARTS) / digest(made_of)


def _part(parts: Path, episode: dict) -> Path:
    return parts / f"{episode['episode_index']}.npy"


def _encode(encoder: FrozenEncoder, images: Tensor, with_patches: bool) -> tuple[np.ndarray, np.ndarray | None]:
    pooled, tokens = encoder.encode(images.to(encoder.device) / 255)
    return pooled.cpu().numpy(), tokens.cpu().numpy().astype(np.float16) if with_patches else None


def _save(file: Path, array: np.ndarray) -> None:
    with replaced(file) as partial:
        np.save(partial, array)


def _write_copy(
    dataset: LeRobotDataset,
    camera: str,
    features: np.ndarray,
    info: dict[str, str],
    repo_id: str,
    folder: Path,
    points: dict[str, np.ndarray],
) -> None:
    key = feature_key(camera)
    made = {key: features, **points}
    columns = {name: {"dtype": "float32", "shape": (of.shape[1],), "names": None} for name, of in made.items()}
    columns[key]["info"] = info
    if points:
        columns[point_key(camera)]["names"] = POINT_NAMES
    with quiet():
        added = {name: (of, columns[name]) for name, of in made.items()}
        copy = modify_features(dataset, added, _left_out(dataset), folder, repo_id)
    # LeRobot takes the variance as a difference of squares, which float32 rounds to nothing far from zero.
    stats = compute_episode_stats({name: of.astype(np.float64) for name, of in made.items()}, columns)
    write_stats({**(copy.meta.stats or {}), **stats}, folder)
    _forget_videos(folder)


def _left_out(dataset: LeRobotDataset) -> list[str]:
    read = [name for name in dataset.meta.features if name.startswith(("observation.", "action"))]
    kept = set(read) - set(dataset.meta.camera_keys) | set(DEFAULT_FEATURES)
    return [name for name in dataset.meta.features if name not in kept]


def _batches(dataset: LeRobotDataset, key: str, episode: dict, batch_size: int) -> Iterator[Tensor]:
    """Yield an episode's (B, 3, H, W) images in [0, 255], so that a video is decoded front to back."""
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
        table = read_parquet(path).to_pandas()
        gone = [name for name in table if name.startswith(("videos/", "stats/observation.images."))]
        table.drop(columns=gone).to_parquet(path, index=False)
