"""The columns of a demonstration data set, and the facts about it that travel beside them.

Every LeRobot policy consumes each `observation.*` column and predicts each `action*` column, so nothing else may
bear those names.
"""

from typing import Any

from lerobot_constructskill.contract import CAMERAS, IMAGE_SIZE, OBS_TYPES, SIM_STATE, STATE_NAMES, Task

ACTORS = EXPERT, LEARNER = "expert", "learner"
"""Whose action was executed in a frame; the demonstrations' noise is the expert's."""

SIDECAR = "meta/constructskill.json"
"""Where a data set keeps how it was made, relative to its root."""


def demonstration_features(task: Task, obs_type: str) -> dict[str, dict[str, Any]]:
    """The `features` of `LeRobotDataset.create` for demonstrations of `task` seen as `obs_type`."""
    action = list(task.action_names)
    return {
        **{CAMERAS[name].key: _video() for name in OBS_TYPES[obs_type]},
        "observation.state": _floats(len(STATE_NAMES), list(STATE_NAMES)),
        "action": _floats(len(action), action),
        "dart.executed_action": _floats(len(action), action),
        "dart.noise": _floats(3, action[:3]),
        "phase": {"dtype": "string", "shape": (1,), "names": None},
        **{f"sim.{name}": _floats(length) for name, length in SIM_STATE.items()},
        "sim.seed": {"dtype": "int64", "shape": (1,), "names": None},
        "next.reward": _floats(1),
        "next.success": {"dtype": "bool", "shape": (1,), "names": None},
        "next.done": {"dtype": "bool", "shape": (1,), "names": None},
    }


def dagger_features(task: Task, obs_type: str) -> dict[str, dict[str, Any]]:
    """The columns of `demonstration_features`, and those that say who was at the wheel."""
    return demonstration_features(task, obs_type) | {
        "dagger.round": {"dtype": "int64", "shape": (1,), "names": None},
        "dagger.actor": {"dtype": "string", "shape": (1,), "names": None},
        "dagger.hopeless": {"dtype": "bool", "shape": (1,), "names": None},
    }


def _video() -> dict[str, Any]:
    return {
        "dtype": "video",
        "shape": (IMAGE_SIZE, IMAGE_SIZE, 3),
        "names": ["height", "width", "channels"],
    }


def _floats(length: int, names: list[str] | None = None) -> dict[str, Any]:
    return {"dtype": "float32", "shape": (length,), "names": names}
