"""The contract of a task in plain values: what its numbers and pictures mean, in which units, ranges and frames.

It is `meta/contract.json` of every data set and `contract` of every environment.
"""

from collections.abc import Iterable, Sequence
from math import degrees
from typing import Any

import numpy as np

from lerobot_constructskill.cameras import intrinsics, pose
from lerobot_constructskill.contract import (
    ACTION_SCALE,
    CAMERAS,
    FINGER_TARGETS,
    FORCE_NAMES,
    FPS,
    GRIPPER,
    GRIPPER_CLOSED,
    GRIPPER_OPEN,
    IMAGE_SIZE,
    MOVED_SHARE,
    ROBOT_BASE,
    ROTATION,
    STATE_NAMES,
    TCP_IN_HAND,
    Camera,
    Task,
)

BASE_FRAME = "robot base: x forward, y to the left, z up; parallel to the world's axes"

STATE_UNITS = dict(zip((*STATE_NAMES, *FORCE_NAMES), ("m",) * 3 + ("rad",) * 3 + ("m",) * 2 + ("N",) * 3, strict=True))

FELT = " Then the force that pulls at the wrist, as a tared sensor shows it."


def describe_task(task: Task, cameras: Iterable[str], state: Sequence[str] = STATE_NAMES) -> dict[str, Any]:
    """The contract of `task`, as it is written to JSON.

    Cameras are the unperturbed ones, also where a perturbation moves them.

    Args:
        cameras: those that are shown, by their names in `contract.CAMERAS`.
        state: channels of `observation.state`; empty where it is not shown.
    """
    meaning = "Position of the end effector, its rotation as axis-angle, and the position of each finger."
    shown = {
        "key": "observation.state",
        "frame": BASE_FRAME,
        "meaning": meaning + (FELT if {*FORCE_NAMES} & {*state} else ""),
        "channels": [{"name": name, "unit": STATE_UNITS[name]} for name in state],
    }
    return {
        "task": task.name,
        **describe_instruction(task),
        "fps": FPS,
        "robot": {
            "name": "Franka Panda",
            "base_in_world": [*ROBOT_BASE],
            "end_effector_in_panda_hand": [*TCP_IN_HAND],
        },
        "action": {
            "key": "action",
            "frame": BASE_FRAME,
            "meaning": (
                f"What the controller is asked for in one step of 1/{FPS} s, from where the hand is. The hand moves "
                f"about {MOVED_SHARE} of it in the step, and stops when nothing is asked for. What is out of range is "
                "clipped. Rotations turn about the axes of the frame, right-handed."
            ),
            "moved_share": MOVED_SHARE,
            "channels": [_describe_channel(name) for name in task.action_names],
        },
        **({"state": shown} if state else {}),
        "cameras": {name: _describe_camera(CAMERAS[name]) for name in cameras},
    }


def describe_instruction(task: Task) -> dict[str, Any]:
    """What a policy is told of `task`: its sentence, and others of the same meaning to train with."""
    return {"instruction": task.instruction, "rewordings": [*next(iter(task.rewordings), ())]}


def _describe_channel(name: str) -> dict[str, Any]:
    if name == GRIPPER:
        closed, opened = FINGER_TARGETS
        meaning = (
            f"Continuous: {GRIPPER_CLOSED:+g} drives each finger to {closed} m (closed), "
            f"{GRIPPER_OPEN:+g} to {opened} m (open), 0 to {(closed + opened) / 2} m."
        )
        return {"name": name, "unit": "1", "low": GRIPPER_CLOSED, "high": GRIPPER_OPEN, "meaning": meaning}
    unit = "rad" if name in ROTATION else "m"
    reach = {"low": -ACTION_SCALE, "high": ACTION_SCALE}
    return {"name": name, "unit": unit, **reach, "meaning": "Asked for in one step."}


def _describe_camera(camera: Camera) -> dict[str, Any]:
    return {
        "key": camera.key,
        "width": IMAGE_SIZE,
        "height": IMAGE_SIZE,
        "vertical_fov_rad": camera.fov,
        "vertical_fov_deg": degrees(camera.fov),
        "intrinsics": _plain(intrinsics(camera)),
        "frame": camera.mount or "world",
        "pose": _plain(pose(camera)),
        "axes": "pose takes points (m) from the camera's axes (OpenCV: x right, y down, z forward) to the frame",
    }


def _plain(matrix: np.ndarray) -> list[list[float]]:
    return (matrix.round(9) + 0.0).tolist()
