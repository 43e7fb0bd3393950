"""The columns of a demonstration data set, and the facts about it that travel beside them.

Every LeRobot policy consumes each `observation.*` column and predicts each `action*` column, so nothing else may
bear those names.
"""

from collections.abc import Iterable, Sequence
from typing import Any, TypedDict

from lerobot_constructskill.contract import CAMERAS, IMAGE_SIZE, PLURALS, SIM_STATE, STATE_NAMES, Task
from lerobot_constructskill.files import Json

ACTORS = EXPERT, LEARNER = "expert", "learner"
"""Whose action was executed in a frame; an expert's action with noise is the expert's."""

SIDECAR = "meta/constructskill.json"
"""The file in which a data set records how it was made, relative to its root."""


class _Made(TypedDict):
    generator: dict[str, Any]


MADE = Json("the record of how a data set was made", _Made)
"""Reads the file `SIDECAR`."""

JOINT_COLUMNS = ("sim.joint_positions", "sim.joint_velocities")
"""Columns that the oldest data sets lack; those sets also have no channel names in `sim.*` and `next.*`."""

PLACEMENT_COLUMNS = tuple(
    f"sim.{name}"
    for name in ("placement", *PLURALS.values(), "is_object", "is_placed", "finger_forces", "object_forces")
)
"""Columns that data sets lack which were made before a task was a list of placements."""


LANGUAGE = dict.fromkeys(
    (PERSISTENT := "language_persistent", EVENTS := "language_events"),
    {"dtype": "language", "shape": (1,), "names": None},
)
"""LeRobot's columns of annotations, in sets that were made with `annotate`."""

VIDEO = {"dtype": "video", "shape": (IMAGE_SIZE, IMAGE_SIZE, 3), "names": ["height", "width", "channels"]}
"""The column of a camera."""


def demonstration_features(
    task: Task, cameras: Iterable[str], state: Sequence[str] = STATE_NAMES
) -> dict[str, dict[str, Any]]:
    """The `features` of `LeRobotDataset.create` for demonstrations of `task` seen by `cameras`.

    Args:
        state: channels of `observation.state`, as `contract.state_names` says.
    """
    return {
        **{CAMERAS[name].key: dict(VIDEO) for name in cameras},
        "observation.state": _column("float32", *state),
        "action": _column("float32", *task.action_names),
        "dart.executed_action": _column("float32", *task.action_names),
        "dart.noise": _column("float32", *task.action_names[:3]),
        "phase": _column("string", "phase"),
        **{f"sim.{name}": _column("float32", *channels) for name, channels in SIM_STATE.items()},
        "sim.seed": _column("int64", "seed"),
        "next.reward": _column("float32", "reward"),
        "next.success": _column("bool", "success"),
        "next.done": _column("bool", "done"),
    }


def dagger_features(
    task: Task, cameras: Iterable[str], state: Sequence[str] = STATE_NAMES
) -> dict[str, dict[str, Any]]:
    """The columns of `demonstration_features`, and those that say who acted."""
    return demonstration_features(task, cameras, state) | {
        "dagger.round": _column("int64", "round"),
        "dagger.actor": _column("string", "actor"),
        "dagger.hopeless": _column("bool", "hopeless"),
    }


def as_made(features: dict[str, dict[str, Any]], joints: bool, placements: bool) -> dict[str, dict[str, Any]]:
    """The columns of a set that may be older than the recording of joints, or than that of lists of placements."""
    missing = {*(() if joints else JOINT_COLUMNS), *(() if placements else PLACEMENT_COLUMNS)}
    named = ("observation.", "action", "dart.")
    return {
        name: feature if joints or name.startswith(named) else feature | {"names": None}
        for name, feature in features.items()
        if name not in missing
    }


def _column(dtype: str, *channels: str) -> dict[str, Any]:
    return {"dtype": dtype, "shape": (len(channels),), "names": list(channels)}
