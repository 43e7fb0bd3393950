"""Feature sets: data sets that carry an encoder's output in place of video, and say whose output it is."""

import hashlib
import json
from collections.abc import Mapping, Sequence
from functools import cache
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from lerobot_constructskill.errors import InputError, MissingError, first_line
from lerobot_constructskill.files import read_parquet
from lerobot_constructskill.lerobot_internals import DATA_SET, INFO

from .backbones import IMAGE_SIZE, Backbone

FEATURE_PREFIX = "observation.features."

PATCHES_FILE = "patch_features.npy"
"""Memory map of the patch features in the root of a feature set: (N, P, D) float16, row i is the frame `index` i."""

BOUND = "patches_sha256"
"""Entry of a feature column's description: hash of the patch features that belong to it, as of `_identity`."""


def cameras_of(camera: str) -> list[str]:
    """The cameras that a policy's `camera` names, `base+wrist` or one alone, in the order in which they are read."""
    return camera.split("+")


def feature_key(camera: str) -> str:
    """Column that holds the encoded frames of `camera`, (D,) float32; of several they stand one after the other."""
    return FEATURE_PREFIX + camera


def point_key(camera: str) -> str:
    """Column that says where in the frames of `camera` a readout's points are, (2P,) float32 from -1 to 1."""
    return f"observation.points.{camera}"


def open_patches(root: Path) -> Tensor:
    """Return the patch features of a feature set, (N, P, D) float16, which stay on the disk until a row is read.

    Raises:
        FileNotFoundError: the set was encoded without them.
        InputError: the file is of other frames, as where the set was edited after it was encoded.
    """
    root = Path(root)
    if not (root / PATCHES_FILE).exists():
        raise MissingError(
            f"The feature set in {root} has no {PATCHES_FILE}, which this readout needs: encode the data set with "
            "constructskill-encode --patches=true, or, if it is from the Hub, download it whole and give its folder."
        )
    return _mapped(root)


def bind_patches(root: Path) -> None:
    """Write the hash of a feature set's patch features into its description."""
    info = DATA_SET.read(root / INFO)
    key = _feature_column(info)
    info["features"][key]["info"][BOUND] = _identity(root, key, np.load(root / PATCHES_FILE, mmap_mode="r"))
    (root / INFO).write_text(json.dumps(info, indent=4, ensure_ascii=False), encoding="utf-8")


def close_patches() -> None:
    """Release what `open_patches` has mapped. Until then a removed file still takes its room on the disk."""
    _mapped.cache_clear()


@cache
def _mapped(root: Path) -> Tensor:
    info = DATA_SET.read(root / INFO)
    key = _feature_column(info)
    try:
        patches = np.load(root / PATCHES_FILE, mmap_mode="c")  # torch takes no read-only memory
    except (ValueError, EOFError) as error:
        raise InputError(f"'{root / PATCHES_FILE}' is damaged ({first_line(error)}).") from None
    if info["features"][key]["info"].get(BOUND) != _identity(root, key, patches):
        raise InputError(
            f"{root / PATCHES_FILE} is not of this feature set's {info['total_frames']} frames, or was written before "
            "sets said which is theirs: encode the data set again with constructskill-encode --patches=true."
        )
    return torch.from_numpy(patches)


def _feature_column(info: Mapping) -> str:
    """Return the name of a feature set's column of features. Raises InputError where there is none."""
    for name in info["features"]:
        if name.startswith(FEATURE_PREFIX):
            return name
    raise InputError(f"A data set without a column {FEATURE_PREFIX}* is no feature set: {PATCHES_FILE} is of another.")


def _identity(root: Path, key: str, patches: np.ndarray) -> str:
    """Hash the pooled features of all frames, and some rows of their patch features."""
    files = sorted((root / "data").glob("*/*.parquet"))
    pooled = np.concatenate([np.stack(read_parquet(file, [key]).to_pandas()[key]) for file in files])
    total = hashlib.sha256(f"{pooled.shape} {patches.shape}".encode())
    total.update(pooled.tobytes())
    for row in np.linspace(0, len(patches) - 1, num=16, dtype=int):
        total.update(patches[row].tobytes())
    return total.hexdigest()


def describe(
    backbone: Backbone,
    weights_sha256: str | None,
    precision: str,
    crop: Sequence[float] | None = None,
    blind: bool = False,
) -> dict[str, str | None]:
    """Return the description of an encoder's features, a column's `info`. A policy that reads them compares it."""
    resize = f"bicubic antialiased to {IMAGE_SIZE}x{IMAGE_SIZE} if of another size"
    cropped = [] if crop is None else [f"crop {[float(edge) for edge in crop]}"]
    seen = ["grey in place of the image", "[0, 1]"] if blind else ["[0, 1]"]
    pixels = [*seen, *cropped, resize, f"mean {list(backbone.mean)}", f"std {list(backbone.std)}"]
    return {
        "backbone": backbone.name,
        "weights_sha256": weights_sha256,
        "precision": precision,
        "readout": backbone.readout,
        "preprocessing": ", ".join(pixels),
    }


def stated(column: Mapping | None, name: str, known: Sequence[str] | None = None) -> str | None:
    """Return one entry of a feature column's description.

    Args:
        column: the column's entry in the data set's `features`.
        name: the entry.
        known: the values that are accepted; by default every text.

    Returns:
        None if there is no column, no such entry, or its value is not accepted.
    """
    found = ((column or {}).get("info") or {}).get(name)
    return found if isinstance(found, str) and (known is None or found in known) else None


def check_features(column: Mapping, expected: Mapping[str, str], dim: int) -> None:
    """Refuse a feature column that another encoder made.

    Args:
        column: the column's entry in the data set's `features`.
        expected: `describe` of the encoder whose features the policy was, or is to be, trained on.
        dim: length D of its features.

    Raises:
        ValueError: the column is described differently, or not at all.
    """
    found = {name: stated(column, name) for name in expected}
    different = [
        f"{name} {found[name] or 'not stated'} (the policy: {wanted})"
        for name, wanted in expected.items()
        if found[name] is None or found[name] != wanted
    ]
    if tuple(column["shape"]) != (dim,):
        different.append(f"shape {tuple(column['shape'])} (the policy: {(dim,)})")
    if different:
        raise InputError(
            f"The data set's features were not made by this policy's encoder: {'; '.join(different)}; "
            "encode the data set again with constructskill-encode or match the policy's backbone fields."
        )
