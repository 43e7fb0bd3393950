"""Poses of one robot on a CPU, with the numbers of ManiSkill's batched ones to the last bit, and of cameras.

ManiSkill's go through torch, where a sum of two numbers costs microseconds and a pose takes a hundred of them. Those
of the robot are the same float32 operations in the same order, on numpy's scalars.
"""

from collections.abc import Sequence
from math import copysign, sqrt

import numpy as np
import sapien
import torch
from mani_skill.utils.structs import Link, Pose

type Numbers = tuple[np.float32, ...]


def seen_from(frame: Link, link: Link) -> Pose:
    """`frame.pose.inv() * link.pose`, of shape (num_envs, 7)."""
    if link.scene.gpu_sim_enabled:
        return frame.pose.inv() * link.pose
    p, q = relative_pose(frame._objs[0].entity_pose, link._objs[0].entity_pose)
    return Pose(torch.from_numpy(np.array([*p, *q])[None]))


def relative_pose(frame: sapien.Pose, pose: sapien.Pose) -> tuple[Numbers, Numbers]:
    """Position and quaternion of `pose` as seen from `frame`."""
    turn = invert(tuple(frame.q))
    origin = rotate(turn, tuple(-number for number in frame.p))
    p = tuple(a + b for a, b in zip(origin, rotate(turn, tuple(pose.p)), strict=True))
    return p, multiply(turn, tuple(pose.q))


def looking_from(eye: Sequence[float], target: Sequence[float]) -> sapien.Pose:
    """Of a camera at `eye` that looks at `target`, both in metres, upright and neither straight up nor down.

    It looks along its x axis. ManiSkill's `look_at` takes roots in float32 with MKL, which is off by a bit on some
    processors and then shows in a few pixels; here, every number is rounded to float32 once.
    """
    x, y, z = (float(b) - float(a) for a, b in zip(eye, target, strict=True))
    level = sqrt(x * x + y * y)
    yaw_cos, yaw_sin = half_angle(x / level, y)
    pitch_cos, pitch_sin = half_angle(level / sqrt(x * x + y * y + z * z), -z)
    q = (yaw_cos * pitch_cos, -yaw_sin * pitch_sin, yaw_cos * pitch_sin, yaw_sin * pitch_cos)
    return sapien.Pose(p=eye, q=q)


def half_angle(cosine: float, side: float) -> tuple[float, float]:
    """Cosine and sine of half an angle, of which the cosine and the sine's sign are known."""
    return sqrt((1 + cosine) / 2), copysign(sqrt((1 - cosine) / 2), side)


def invert(q: Numbers) -> Numbers:
    w, x, y, z = q
    return w, -x, -y, -z


def rotate(q: Numbers, point: Numbers) -> Numbers:
    return raw_multiply(raw_multiply(q, (np.float32(0), *point)), invert(q))[1:]


def multiply(a: Numbers, b: Numbers) -> Numbers:
    """The rotation `b` followed by `a`, its real part not negative."""
    product = raw_multiply(a, b)
    return tuple(-number for number in product) if product[0] < 0 else product


def raw_multiply(a: Numbers, b: Numbers) -> Numbers:
    aw, ax, ay, az = a
    bw, bx, by, bz = b
    return (
        aw * bw - ax * bx - ay * by - az * bz,
        aw * bx + ax * bw + ay * bz - az * by,
        aw * by - ax * bz + ay * bw + az * bx,
        aw * bz + ax * by - ay * bx + az * bw,
    )
