"""Projects the object, the receptacle and the hand into a camera's picture, from a data set's privileged state."""

from collections.abc import Mapping
from math import tan

import numpy as np

from lerobot_constructskill.cameras import axes
from lerobot_constructskill.contract import CAMERAS, IMAGE_SIZE, TCP_IN_HAND, Camera
from lerobot_constructskill.errors import InputError
from lerobot_constructskill.policies.frozen_vit.encoder import Crop
from lerobot_constructskill.policies.frozen_vit.readouts import POINTS

POSES = dict(zip(POINTS, ("sim.object_pose", "sim.bin_position", "sim.tcp_pose"), strict=True))
"""Column whose first three numbers are a point's position, in metres in the world's frame."""


def find_points(columns: Mapping[str, np.ndarray], camera: str, crop: Crop | None = None) -> np.ndarray:
    """Return (N, 2P) float32, `readouts.POINT_NAMES` in the cropped picture, from -1 to 1.

    A point outside the picture is where its edge is nearest.

    Args:
        columns: the data set's, by name, (N, ...) each.
        camera: one of `contract.CAMERAS`.
        crop: the part of the picture that is encoded.

    Raises:
        ValueError: the data set does not say where things are, or no such camera is known.
    """
    missing = sorted({*POSES.values()} - {*columns})
    if missing:
        raise InputError(
            f"The data set does not say where things are (it has no {', '.join(missing)}), as this benchmark's "
            "demonstrations do: encode it without points, for a readout other than heat_maps."
        )
    if camera not in CAMERAS:
        raise InputError(f"Where '{camera}' looks from is not known; points are for {', '.join(CAMERAS)}.")
    hands = np.stack(columns[POSES["hand"]]).astype(float)
    positions = [np.stack(columns[POSES[name]]).astype(float)[:, :3] for name in POINTS]
    seen = [_cropped(_project(CAMERAS[camera], position, hands), crop) for position in positions]
    return np.concatenate(seen, axis=1).clip(-1, 1).astype(np.float32)


def _project(camera: Camera, positions: np.ndarray, hands: np.ndarray) -> np.ndarray:
    """World positions (N, 3), in metres, as positions in a square picture: (N, 2), from -1 to 1."""
    right, down, forward = axes(camera)
    if camera.mount is None:
        offsets = positions - camera.eye
    else:
        links = hands[:, :3] - _rotate(hands[:, 3:], np.array(TCP_IN_HAND))
        offsets = _rotate(hands[:, 3:] * [1, -1, -1, -1], positions - links) - camera.eye
    depth = np.maximum(offsets @ forward, 1e-3)
    return np.stack([offsets @ right, offsets @ down], axis=1) / depth[:, None] / tan(camera.fov / 2)


def _rotate(quaternions: np.ndarray, vectors: np.ndarray) -> np.ndarray:
    """Vectors (N, 3), or one (3,), turned by unit quaternions (w, x, y, z)."""
    w, axis = quaternions[:, :1], quaternions[:, 1:]
    return vectors + 2 * np.cross(axis, np.cross(axis, vectors) + w * vectors)


def _cropped(positions: np.ndarray, crop: Crop | None) -> np.ndarray:
    """Positions in a picture as positions in the part of it that `FrozenEncoder` looks at."""
    if crop is None:
        return positions
    left, top, right, bottom = (round(edge * IMAGE_SIZE) / IMAGE_SIZE * 2 - 1 for edge in crop)
    middle = np.array([left + right, top + bottom]) / 2
    return (positions - middle) / (np.array([right - left, bottom - top]) / 2)
