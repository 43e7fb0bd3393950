"""Writes a feature set: a LeRobotDataset through a frozen encoder, once."""

import shutil
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
import torch
from lerobot.datasets import LeRobotDataset, modify_features, write_stats
from lerobot.utils import DEFAULT_FEATURES
from torch import Tensor

from lerobot_constructskill.artifacts.digests import data_sha256, digest
from lerobot_constructskill.artifacts.disk import check_free
from lerobot_constructskill.artifacts.folders import replaced
from lerobot_constructskill.contract import IMAGE_SIZE
from lerobot_constructskill.errors import InputError
from lerobot_constructskill.features.points import POSES, find_points
from lerobot_constructskill.files import read_parquet
from lerobot_constructskill.lerobot_internals import compute_episode_stats, decode_video_frames
from lerobot_constructskill.policies.frozen_vit.backbones import get_backbone
from lerobot_constructskill.policies.frozen_vit.encoder import Crop, FrozenEncoder
from lerobot_constructskill.policies.frozen_vit.feature_sets import (
    PATCHES_FILE,
    bind_patches,
    cameras_of,
    describe,
    feature_key,
    point_key,
)
from lerobot_constructskill.policies.frozen_vit.language import CONTRACT
from lerobot_constructskill.policies.frozen_vit.precision import AUTO, check_native, resolve_precision
from lerobot_constructskill.policies.frozen_vit.readouts import POINT_NAMES
from lerobot_constructskill.policies.frozen_vit.weights import load_weights, state_sha256
from lerobot_constructskill.progress import Progress, quiet

PARTS = "encoded"
"""Folder for finished episodes, beside the feature set in the making."""

PATCHES = ".patches.npy"

BATCH, BATCHES = 16, {"cuda": 256}
"""Images a batch: by default, and on devices where larger batches are faster. On these the last bits of a feature
depend on the batch, so the description of the features names its size."""


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
    """The size of the batch, as the description of features names it on a device of `BATCHES`; else nothing."""
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
    """Write a copy of `dataset` with the pooled features of a camera, (N, D) float32, in place of its images.

    Of several cameras, `base+wrist`, the pooled features and the patches stand one after the other.

    Indices, episodes, tasks, actions and other observations stay as they are; columns that no policy reads are left
    out, because LeRobot's loader takes time for each.

    Args:
        encoder: what encodes, and with `info` its description, as `load_encoder` returns them.
        folder: where to, a path that `staged` gave; episodes that a killed run finished are not encoded again.
        batch_size: images at a time; by default as many as suit the encoder's device.
        patches: whether to write every patch's feature as well, to `PATCHES_FILE`.
        points: whether to write as well where in the image the points of `readouts.POINTS` are.

    Raises:
        ValueError: the data set has no such camera, or does not say where things are.
        MachineError: the disk could not hold the patches' features.
    """
    batch_size = batch_size or BATCHES.get(encoder.device.type, BATCH)
    info = info | _source(dataset) | batch_facts(encoder.device, batch_size)
    poses = {name: _column(dataset, name) for name in POSES.values() if points and name in dataset.meta.features}
    found = {point_key(camera): find_points(poses, camera, encoder.crop)} if points else {}
    # All that decides the content is in the folder's name, so parts of other encoders are never taken.
    each = {
        name: folder.with_name(PARTS) / digest({**info, "camera": name, "patches": patches})
        for name in cameras_of(camera)
    }
    for name in each:
        _check_camera(dataset, name)
    size = dataset.num_frames * _patch_bytes(encoder) if patches else 0
    _check_room(dataset, size, [*each.values()], folder)
    made = [_encode_frames(dataset, name, encoder, batch_size, parts, size) for name, parts in each.items()]
    columns = {feature_key(camera): np.concatenate(made, axis=1), **found}
    episodes = dataset.meta.episodes if patches else []
    files = [[_part(parts, episode).with_suffix(PATCHES) for parts in each.values()] for episode in episodes]
    _write_copy(dataset, camera, columns, files, info, repo_id, folder)


def _check_camera(dataset: LeRobotDataset, camera: str) -> None:
    if (key := f"observation.images.{camera}") not in dataset.meta.camera_keys:
        cameras = ", ".join(dataset.meta.camera_keys) or "none"
        raise InputError(f"The data set '{dataset.repo_id}' has no {key}; its cameras are: {cameras}.")


def _patch_bytes(encoder: FrozenEncoder) -> int:
    """Bytes that the features of an image's patches take."""
    _, tokens = encoder.encode(torch.zeros(1, 3, IMAGE_SIZE, IMAGE_SIZE, device=encoder.device))
    return tokens.half().nbytes


def _check_room(dataset: LeRobotDataset, size: int, parts: Sequence[Path], folder: Path) -> None:
    """Refuse a disk that could not hold every patch's feature twice, by episode and joined.

    Args:
        size: bytes that those of one camera take.
        parts: each camera's folder for finished episodes.
    """
    there = sum(file.stat().st_size for own in parts for file in own.glob(f"*{PATCHES}"))
    needed = 2 * len(parts) * size - there
    check_free(
        folder,
        needed,
        f", and the patch features of {dataset.num_frames:,} frames take {needed / 1e6:,.0f} MB more until they are "
        "put together: make room, or write to another disk.",
    )


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
    names = [feature_key(camera), *([point_key(camera)] if points else [])]
    columns = {name: np.concatenate([_column(part, name) for part in parts]) for name in names}
    if len(columns[feature_key(camera)]) != dataset.num_frames:
        raise InputError(f"The parts of '{dataset.repo_id}' do not add up to its {dataset.num_frames} frames.")
    files = [[part.root / PATCHES_FILE] for part in parts] if patches else []
    _write_copy(dataset, camera, columns, files, info | _source(dataset), repo_id, folder)


def _column(dataset: LeRobotDataset, name: str) -> np.ndarray:
    return np.stack(dataset.hf_dataset.with_format("numpy")[name][:])


def _join_files(files: Sequence[Sequence[Path]], frames: int, joined: Path) -> None:
    """Write the rows of files of patch features into one of so many frames.

    Args:
        files: those of each episode, or each part, of which one is open at a time; one a camera. One alone, which may
            be larger than the memory, is not loaded.
    """
    opened = ([np.load(file, mmap_mode="r") for file in own] for own in files)
    first = [np.load(file, mmap_mode="r").shape for file in files[0]]
    shape = (frames, sum(patches for _, patches, _ in first), first[0][2])
    header = {"descr": np.lib.format.dtype_to_descr(np.dtype(np.float16)), "fortran_order": False, "shape": shape}
    with joined.open("wb") as out:  # a full disk raises here; under a memory map it would kill the process
        np.lib.format.write_array_header_1_0(out, header)
        for own in opened:
            out.write(own[0] if len(own) == 1 else np.concatenate(own, axis=1))


def _source(dataset: LeRobotDataset) -> dict[str, str]:
    return {"source_repo_id": dataset.repo_id, "source_sha256": data_sha256(dataset.root)}


def _encode_frames(
    dataset: LeRobotDataset, camera: str, encoder: FrozenEncoder, batch_size: int, parts: Path, size: int
) -> np.ndarray:
    """Encode every frame of one camera to (N, D) float32, in the order of the data set, by way of `parts`.

    Args:
        size: bytes that the features of its patches take; 0 where these are not kept.
    """
    key = f"observation.images.{camera}"
    missing = [episode for episode in dataset.meta.episodes if not _part(parts, episode).exists()]
    finished = dataset.num_frames - sum(episode["length"] for episode in missing)
    desc = f"Encoding {camera}" + (f", {size / 1e6:,.0f} MB" if size else "")
    # Frames of an earlier run are where the bar starts, not part of its rate.
    with Progress(total=dataset.num_frames, initial=finished, unit="frame", desc=desc) as progress:
        for episode in missing:
            batches = []
            for images in _ahead(_batches(dataset, key, episode, batch_size)):
                batches.append(_encode(encoder, images, bool(size)))
                progress.update(len(images))
            pooled, tokens = zip(*batches, strict=True)
            made = {PATCHES: tokens, ".npy": pooled} if size else {".npy": pooled}
            for suffix, arrays in made.items():  # the pooled ones last: they say that the episode is finished
                with replaced(_part(parts, episode).with_suffix(suffix)) as partial:
                    np.save(partial, np.concatenate(arrays))
    return np.concatenate([np.load(_part(parts, episode)) for episode in dataset.meta.episodes])


def _part(parts: Path, episode: dict) -> Path:
    return parts / f"{episode['episode_index']}.npy"


def _encode(encoder: FrozenEncoder, images: Tensor, with_patches: bool) -> tuple[np.ndarray, np.ndarray | None]:
    pooled, tokens = encoder.encode(images.to(encoder.device) / 255)
    return pooled.cpu().numpy(), tokens.half().cpu().numpy() if with_patches else None


def _write_copy(
    dataset: LeRobotDataset,
    camera: str,
    columns: dict[str, np.ndarray],
    patches: Sequence[Sequence[Path]],
    info: dict[str, str],
    repo_id: str,
    folder: Path,
) -> None:
    """Write a data set's copy with these columns in place of images, and with the patch features of some files."""
    described = {
        feature_key(camera): {"names": None, "info": info},
        point_key(camera): {"names": POINT_NAMES},
    }
    features = {
        name: {"dtype": "float32", "shape": (column.shape[1],), **described[name]} for name, column in columns.items()
    }
    read = {name for name in dataset.meta.features if name.startswith(("observation.", "action"))}
    kept = read - set(dataset.meta.camera_keys) | set(DEFAULT_FEATURES)
    left_out = [name for name in dataset.meta.features if name not in kept]
    with quiet():
        added = {name: (column, features[name]) for name, column in columns.items()}
        copy = modify_features(dataset, added, left_out, folder, repo_id)
    # LeRobot takes the variance as a difference of squares, which float32 rounds to nothing far from zero.
    stats = compute_episode_stats({name: column.astype(np.float64) for name, column in columns.items()}, features)
    write_stats({**(copy.meta.stats or {}), **stats}, folder)
    _forget_videos(folder)
    if (contract := dataset.root / CONTRACT).is_file():
        shutil.copyfile(contract, folder / CONTRACT)
    if patches:
        _join_files(patches, dataset.num_frames, folder / PATCHES_FILE)
        bind_patches(folder)


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


def _ahead[Item](items: Iterator[Item]) -> Iterator[Item]:
    """Yield items of which the next one is made meanwhile, in another thread: a video is decoded on one core."""
    with ThreadPoolExecutor(1) as thread:
        coming = thread.submit(next, items, None)
        while (item := coming.result()) is not None:
            coming = thread.submit(next, items, None)
            yield item


def _forget_videos(root: Path) -> None:
    """Drop the columns of the copied episode tables about videos that the copy does not have."""
    for path in (root / "meta" / "episodes").rglob("*.parquet"):
        table = read_parquet(path).to_pandas()
        gone = [name for name in table if name.startswith(("videos/", "stats/observation.images."))]
        table.drop(columns=gone).to_parquet(path, index=False)
