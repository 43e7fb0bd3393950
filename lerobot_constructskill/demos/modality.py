"""GR00T's `meta/modality.json`: which numbers of the state and the action belong together."""

from typing import Any

from lerobot_constructskill.contract import CAMERAS, GRIPPER, OBS_TYPES, ROTATION, STATE_NAMES, TRANSLATION, Task

MODALITY = "meta/modality.json"

STATE_PARTS = {
    "end_effector_position": STATE_NAMES[:3],
    "end_effector_rotation": STATE_NAMES[3:6],
    "gripper": STATE_NAMES[6:],
}
ACTION_PARTS = {"end_effector_position": TRANSLATION, "end_effector_rotation": ROTATION, "gripper": (GRIPPER,)}


def modality(task: Task, obs_type: str) -> dict[str, Any]:
    """The content of the file for a data set of `task` seen as `obs_type`."""
    return {
        "state": _spans(STATE_PARTS, STATE_NAMES),
        "action": _spans(ACTION_PARTS, task.action_names),
        "video": {name: {"original_key": CAMERAS[name].key} for name in OBS_TYPES[obs_type]},
        "annotation": {"human.task_description": {"original_key": "task_index"}},
    }


def _spans(parts: dict[str, tuple[str, ...]], names: tuple[str, ...]) -> dict[str, dict[str, int]]:
    spans = {}
    for part, wanted in parts.items():
        indices = [index for index, name in enumerate(names) if name in wanted]
        if indices:
            spans[part] = {"start": indices[0], "end": indices[-1] + 1}
    return spans
