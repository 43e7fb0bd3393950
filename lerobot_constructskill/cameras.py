"""Where the contract's cameras stand and what they see, in OpenCV's axes: x to the right, y down, z forward."""

from math import tan

import numpy as np

from lerobot_constructskill.contract import IMAGE_SIZE, Camera


def axes(camera: Camera) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The camera's x, y and z axis, (3,) each: in the world, or in the frame of the link that carries it."""
    if camera.mount is not None:  # it looks along the link's z axis
        return np.array([0.0, -1.0, 0.0]), np.array([1.0, 0.0, 0.0]), np.array([0.0, 0.0, 1.0])
    forward = np.subtract(camera.target, camera.eye)
    right = np.cross(forward, [0.0, 0.0, 1.0])
    forward, right = forward / np.linalg.norm(forward), right / np.linalg.norm(right)
    return right, np.cross(forward, right), forward


def pose(camera: Camera) -> np.ndarray:
    """Transform from the camera's axes to the world, or to the frame of the link that carries it: (4, 4), metres."""
    return np.vstack([np.stack([*axes(camera), camera.eye], axis=1), [0.0, 0.0, 0.0, 1.0]])


def intrinsics(camera: Camera) -> np.ndarray:
    """Projection from the camera's axes to square pixels, (3, 3); their origin is the picture's upper left corner."""
    middle = IMAGE_SIZE / 2
    focal = middle / tan(camera.fov / 2)
    return np.array([[focal, 0.0, middle], [0.0, focal, middle], [0.0, 0.0, 1.0]])
