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
    """From points in the camera's axes to points in the world, or in the frame of its link: (4, 4), metres."""
    matrix = np.eye(4)
    matrix[:3, :3] = np.stack(axes(camera), axis=1)
    matrix[:3, 3] = camera.eye
    return matrix


def intrinsics(camera: Camera) -> np.ndarray:
    """From points in the camera's axes to pixels: (3, 3), square pixels, the origin at the picture's upper left."""
    middle = IMAGE_SIZE / 2
    focal = middle / tan(camera.fov / 2)
    return np.array([[focal, 0.0, middle], [0.0, focal, middle], [0.0, 0.0, 1.0]])
