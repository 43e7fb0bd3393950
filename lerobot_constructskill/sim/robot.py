"""The Panda: its controllers and poses on a CPU, with ManiSkill's numbers to the last bit, and its light-weight look.

ManiSkill's controllers and poses go through torch, where a sum of two numbers costs microseconds and a pose takes a
hundred of them. For one robot on a CPU this module does the same float32 operations in the same order on numpy's
scalars. What may round differently (norms, sines, products of matrices) stays ManiSkill's and torch's. On a GPU these
controllers are ManiSkill's own.
"""

from collections.abc import Iterable
from html import escape
from pathlib import Path

import numpy as np
import sapien
import torch
from mani_skill.agents.controllers import PDEEPoseController, PDJointPosMimicController
from mani_skill.agents.registration import register_agent
from mani_skill.agents.robots import Panda
from mani_skill.utils.geometry.rotation_conversions import euler_angles_to_matrix, matrix_to_quaternion
from mani_skill.utils.structs import ArticulationJoint, Link, Pose

from lerobot_constructskill.sim.visuals import written_once

type Numbers = tuple[np.float32, ...]

LIGHT_MESHES = Path(__file__).with_name("panda_light")
"""The Panda's visual meshes with 4,000 triangles in place of 135,000; `benchmarks/light_panda.py` makes them."""

NO_TURN = (np.float32(1), np.float32(0), np.float32(0), np.float32(0))

IK_ITERATIONS = 100
"""At most; ManiSkill's number."""


class QuickPoseController(PDEEPoseController):
    """The arm: its joints go where the action, (1, 6), moves the tool, or stay where there is no solution."""

    def set_action(self, action: torch.Tensor) -> None:
        if self.scene.gpu_sim_enabled:
            return super().set_action(action)
        self._step = 0
        moved, turned = _displacement(self._preprocess_action(action))
        p, q = relative_pose(self.root_link._objs[0].entity_pose, self.ee_link._objs[0].entity_pose)
        target = sapien.Pose([a + b for a, b in zip(p, moved, strict=True)], multiply(turned, q))
        qpos, kinematics = self.articulation._objs[0].qpos, self.kinematics
        solution, success, _ = kinematics.pmodel.compute_inverse_kinematics(
            kinematics.end_link_idx,
            target,
            initial_qpos=qpos[kinematics.pmodel_active_joint_indices],
            active_qmask=kinematics.qmask,
            max_iterations=IK_ITERATIONS,
        )
        solved = solution[kinematics.pmodel_controlled_joint_indices]
        _drive(self.joints, solved if success else qpos[self.active_joint_indices])


class QuickMimicController(PDJointPosMimicController):
    """The fingers, which all go where the action, (1, 1), says."""

    def set_action(self, action: torch.Tensor) -> None:
        if self.scene.gpu_sim_enabled:
            return super().set_action(action)
        self._step = 0
        opening = self._preprocess_action(action).item()
        _drive(self.joints, [opening] * len(self.joints))


def _displacement(action: torch.Tensor) -> tuple[Numbers, Numbers]:
    """Translation and quaternion that an action in metres and radians asks for."""
    moved, angles = tuple(action[0, :3].numpy()), action[:, 3:]
    if not angles.any():
        return moved, NO_TURN
    return moved, tuple(matrix_to_quaternion(euler_angles_to_matrix(angles, "XYZ"))[0].numpy())


def _drive(joints: list[ArticulationJoint], targets: Iterable[float]) -> None:
    for joint, target in zip(joints, targets, strict=True):
        joint._objs[0].drive_target = np.array([target], dtype=np.float32)


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


def invert(q: Numbers) -> Numbers:
    return q[0], -q[1], -q[2], -q[3]


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


@register_agent()
class QuickPanda(Panda):
    """ManiSkill's Panda, whose `pd_ee_delta_pose` computes the same numbers sooner on a CPU."""

    uid = "constructskill_panda"

    @property
    def _controller_configs(self):
        configs = super()._controller_configs
        configs["pd_ee_delta_pose"]["arm"].controller_cls = QuickPoseController
        configs["pd_ee_delta_pose"]["gripper"].controller_cls = QuickMimicController
        return configs


@register_agent()
class LightPanda(QuickPanda):
    """`QuickPanda` drawn with the light meshes: without a GPU a frame's cost is its number of triangles.

    Links, collision meshes and controllers are the same, so physics does not know which robot is drawn.
    """

    uid = "constructskill_panda_light"

    @property
    def urdf_path(self) -> str:
        """Path of ManiSkill's URDF with the visual meshes replaced.

        Its SRDF, which lists the links whose contact is ignored, stands beside it: SAPIEN looks for it there.
        """
        source, meshes = Path(Panda.urdf_path), "franka_description/meshes"
        urdf = source.read_text(encoding="utf-8").replace(f"{meshes}/visual", escape(str(LIGHT_MESHES)))
        urdf = urdf.replace(meshes, escape(str(source.parent / meshes)))
        srdf = source.with_suffix(".srdf").read_text(encoding="utf-8")
        return str(written_once("panda_light", {"panda.urdf": urdf, "panda.srdf": srdf}) / "panda.urdf")
