"""What stands beside the frames of a data set: GR00T's `meta/modality.json`, our `meta/contract.json`, and hashes."""

import json
from collections.abc import Collection, Iterable, Sequence
from pathlib import Path
from typing import Any

from lerobot_constructskill.artifacts.digests import file_sha256, files_below
from lerobot_constructskill.contract import CAMERAS, FORCE_NAMES, GRIPPER, ROTATION, STATE_NAMES, TRANSLATION, Task
from lerobot_constructskill.demos.columns import SIDECAR
from lerobot_constructskill.interface import describe_instruction, describe_task

MODALITY, CONTRACT = "meta/modality.json", "meta/contract.json"

STATE_PARTS = {
    "end_effector_position": STATE_NAMES[:3],
    "end_effector_rotation": STATE_NAMES[3:6],
    "gripper": STATE_NAMES[6:],
    "force": FORCE_NAMES,
}
ACTION_PARTS = {"end_effector_position": TRANSLATION, "end_effector_rotation": ROTATION, "gripper": (GRIPPER,)}


def write_meanings(
    root: Path, tasks: Sequence[Task], cameras: Collection[str], state: Sequence[str] = STATE_NAMES
) -> None:
    """Write both files of a data set of `tasks`, whose actions are alike, seen by `cameras`.

    Args:
        state: the channels of its state.
    """
    told = {MODALITY: modality(tasks[0], cameras, state), CONTRACT: meaning(tasks, cameras, state)}
    for name, content in told.items():
        (root / name).write_text(json.dumps(content, indent=2) + "\n", encoding="utf-8")


def meaning(tasks: Sequence[Task], cameras: Iterable[str], state: Sequence[str] = STATE_NAMES) -> dict[str, Any]:
    """The contract of `tasks`; several stand in a list `tasks`, each with its name and instruction."""
    contract = describe_task(tasks[0], cameras, state)
    if len(tasks) == 1:
        return contract
    named = [{"task": task.name, **describe_instruction(task)} for task in tasks]
    return {"tasks": named} | {name: value for name, value in contract.items() if name not in named[0]}


def modality(task: Task, cameras: Iterable[str], state: Sequence[str] = STATE_NAMES) -> dict[str, Any]:
    """GR00T's file for a data set of `task` seen by `cameras`: which numbers belong together."""
    return {
        "state": _spans(STATE_PARTS, state),
        "action": _spans(ACTION_PARTS, task.action_names),
        "video": {name: {"original_key": CAMERAS[name].key} for name in cameras},
        "annotation": {"human.task_description": {"original_key": "task_index"}},
    }


def _spans(parts: dict[str, tuple[str, ...]], names: Sequence[str]) -> dict[str, dict[str, int]]:
    spans = {}
    for part, wanted in parts.items():
        indices = [index for index, name in enumerate(names) if name in wanted]
        if indices:
            spans[part] = {"start": indices[0], "end": indices[-1] + 1}
    return spans


def file_hashes(root: Path) -> dict[str, str]:
    """SHA-256 of all files of frames, videos and metadata by relative path, without the record of the hashes."""
    names = (path.relative_to(root).as_posix() for path in files_below(root, "data", "videos", "meta"))
    return {name: file_sha256(root / name) for name in names if name != SIDECAR}
