"""ManiSkill's `pd_ee_delta_pose` for one robot on a CPU: the same numbers to the last bit, sooner.

What may round otherwise elsewhere (norms, sines, products of matrices) stays ManiSkill's and torch's; the rest is done
on numpy's scalars, as in `poses`. On a GPU these controllers are ManiSkill's own.
"""

from collections.abc import Iterable

import numpy as np
import sapien
import torch
from mani_skill.agents.controllers import PDEEPoseController, PDJointPosMimicController
from mani_skill.utils.geometry.rotation_conversions import euler_angles_to_matrix, matrix_to_quaternion
from mani_skill.utils.structs import ArticulationJoint

from lerobot_constructskill.sim.poses import Numbers, multiply, relative_pose

NO_TURN = (np.float32(1), np.float32(0), np.float32(0), np.float32(0))

IK_ITERATIONS = 100
"""At most; ManiSkill's number."""


class QuickPoseController(PDEEPoseController):
    """The arm: the joints that take the tool from where it is to where the action, (1, 6), moves it."""

    def set_action(self, action: torch.Tensor) -> None:
        if self.scene.gpu_sim_enabled:
            return super().set_action(action)
        self._step = 0
        moved, turned = _displacement(self._preprocess_action(action))
        p, q = relative_pose(self.root_link._objs[0].entity_pose, self.ee_link._objs[0].entity_pose)
        target = sapien.Pose([a + b for a, b in zip(p, moved, strict=True)], multiply(turned, q))
        _drive(self.joints, self._solve(target))

    def _solve(self, target: sapien.Pose) -> np.ndarray:
        """The controlled joints at `target`, or as they are where there is no solution."""
        qpos, kinematics = self.articulation._objs[0].qpos, self.kinematics
        solution, success, _ = kinematics.pmodel.compute_inverse_kinematics(
            kinematics.end_link_idx,
            target,
            initial_qpos=qpos[kinematics.pmodel_active_joint_indices],
            active_qmask=kinematics.qmask,
            max_iterations=IK_ITERATIONS,
        )
        return solution[kinematics.pmodel_controlled_joint_indices] if success else qpos[self.active_joint_indices]


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
