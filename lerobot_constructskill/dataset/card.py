"""A data set's card: its README.md on the Hub, rendered from the data and the contract table."""

import json
import re
from importlib.resources import files
from typing import Any

import numpy as np

from lerobot_constructskill.contract import (
    CAMERAS,
    DEMO_SEED_START,
    FORCE_NAMES,
    FPS,
    OBS_TYPES,
    ROTATION,
    TASK_ACTION,
    held_out,
    list_tasks,
    state_names,
)
from lerobot_constructskill.dataset.dataset import DataSet, check_provenance_fields
from lerobot_constructskill.demos.columns import LANGUAGE, SIDECAR, as_made, dagger_features, demonstration_features
from lerobot_constructskill.demos.expert import Phase
from lerobot_constructskill.demos.settings import generator_facts
from lerobot_constructskill.errors import InputError
from lerobot_constructskill.interface import describe_task

MEANINGS = {
    "observation.state": "end effector's position (m) and axis-angle (rad) in the robot's base frame; the fingers (m)",
    "action": "displacement asked for in a step, m, robot's base frame, x forward, z up; gripper +1 open, -1 closed",
    "dart.executed_action": "what was executed: the clean action and the noise, clipped",
    "dart.noise": "executed minus clean translation, m",
    "phase": "the expert's phase of this action",
    "sim.tcp_pose": "privileged: end effector, position (m) and quaternion (w, x, y, z), world frame",
    "sim.fingers": "privileged: finger positions, m",
    "sim.object_pose": "privileged: object, position (m) and quaternion (w, x, y, z), world frame",
    "sim.object_size": "privileged: object's edges, m",
    "sim.object_mass": "privileged: object's mass, kg",
    "sim.bin_position": "privileged: centre of the bin's interior, m, world frame",
    "sim.bin_interior": "privileged: the bin's inner edges, m",
    "sim.joint_positions": "privileged: the arm's seven joints (rad) and the two fingers (m)",
    "sim.joint_velocities": "privileged: velocities of the same joints (rad/s, m/s)",
    "sim.placement": "privileged: number of the placement that object_* and bin_* above are of, the next one",
    "sim.object_poses": "privileged: poses of all objects, in the order in which they are placed",
    "sim.object_sizes": "privileged: edges of each, m",
    "sim.object_masses": "privileged: mass of each, kg",
    "sim.bin_positions": "privileged: where each goes, m, world frame",
    "sim.bin_interiors": "privileged: inner edges of that, m",
    "sim.is_object": "privileged: 1 for each object that there is, 0 for the rest of the nine",
    "sim.is_placed": "privileged: 1 for each object that is placed",
    "sim.finger_forces": "privileged: net contact force on each finger, without friction, N, world frame",
    "sim.object_forces": "privileged: largest contact force between each object and another body, N",
    "sim.seed": "seed of the episode's initial state and noise",
    "language_persistent": "the expert's subtasks, each from its first frame on, and other words for the task",
    "language_events": "none",
    "dagger.round": "the round in which the frame came about, 0 for demonstrations",
    "dagger.actor": "whose action was executed: the expert's (in demonstrations with noise) or the learner's",
    "dagger.hopeless": "whether the expert knows no way to success from here; it then opens, rises and waits",
    "next.reward": "stage reached after the action: 0, 0.5 lifted, 1 placed",
    "next.success": "whether the object is placed after the action",
    "next.done": "whether the episode ends with the action",
}

ADVISED = {
    "dart.noise": "executed translation minus the expert's clean one, in DAgger's rounds minus the advised one, m",
    "phase": "the expert's phase, in a demonstration that of what it did itself and not of the advice",
}
"""Other meanings, for data sets whose `action` is the expert's advice."""

ACTIVE = re.compile(r"[\x00-\x1f`]|\]\(")
"""Characters that would end a line, a piece of code or a link's name; HTML is escaped too."""

FELT = "; what pulls at the wrist (N)"
"""What follows the meaning of a state that has the force."""

TURNS = "; turns in rad about the same axes, right-handed"
"""What follows the meaning of an action in a task that turns."""


def card_facts(data: DataSet) -> dict[str, Any]:
    """The facts of a card as plain values, which can be kept in JSON and compared with the data later.

    Raises:
        InputError: a field of the data set's metadata has an impossible value.
    """
    check_provenance_fields(data.facts)
    if np.shape(covariance := data.facts["noise_covariance"]) != (3, 3):
        raise InputError(f"{SIDECAR}: noise_covariance must be 3 x 3, not {covariance}.")
    if unknown := {str(phase) for phase in data.column("phase")} - {str(phase) for phase in Phase}:
        raise InputError(f"phase has the value {min(unknown)[:40]!a}, which is no phase of an expert.")
    lengths = [span.stop - span.start for span in data.spans()]
    experts = data.rounds == 0
    phases, noise = data.column("phase")[experts], data.column("dart.noise")[experts]
    base = data.column("sim.tcp_pose")[0, :3] - data.column("observation.state")[0, :3]
    of_some = {name: data.facts[name] for name in ("dagger", "tasks") if name in data.facts}
    return of_some | {
        "repo_id": data.config.repo_id,
        "generator": generator_facts(data.config),
        "noise_covariance": data.facts["noise_covariance"],
        "versions": data.facts["versions"],
        "attempts": data.facts["attempts"],
        "discarded_seeds": data.facts["discarded_seeds"],
        "episodes": len(lengths),
        "frames": len(data.rows),
        "joints": data.has_joints,
        "placements": data.has_placements,
        "shortest": min(lengths),
        "longest": max(lengths),
        "held_out": held_out(data.task_names),
        "robot_base": [round(float(value), 3) + 0.0 for value in base],
        "phases": {
            str(phase): {
                "frames": int((phases == phase).sum()),
                "noise_mm": [round(1000 * float(value), 2) for value in noise[phases == phase].std(axis=0)],
            }
            for phase in Phase
            if (phases == phase).any()
        },
        "action_range": _action_range(data),
    }


def _action_range(data: DataSet) -> dict[str, list[float]]:
    """Name of an action's number to its first and last percentile."""
    try:
        names = data.info["features"]["action"]["names"]
        edges = np.array([data.stats["action"][edge] for edge in ("q01", "q99")], dtype=float)
        named = list(zip(names, edges.T, strict=True))
    except (KeyError, TypeError, ValueError, IndexError):
        raise InputError("meta/stats.json has not one q01 and q99 for each name of action in info.json.") from None
    return {name: [round(float(edge), 4) for edge in both] for name, both in named}


def render(facts: dict[str, Any]) -> str:
    """The card of a data set with these facts, in Markdown with the Hub's front matter."""
    generator = facts["generator"]
    tasks = list_tasks(generator["task"], generator.get("action", TASK_ACTION))
    columns = dagger_features if "dagger" in facts else demonstration_features
    seen, state = generator.get("cameras") or OBS_TYPES[generator["obs_type"]], state_names(generator["obs_type"])
    features = as_made(columns(tasks[0], seen, state), bool(facts.get("joints")), bool(facts.get("placements")))
    features |= LANGUAGE if generator.get("annotate") else {}
    cameras = [CAMERAS[name] for name in seen]
    sigma = 1000 * np.sqrt(np.diag(facts["noise_covariance"]))
    return render_template(
        "card.md.j2",
        **facts,
        of_tasks=tasks,
        fps=FPS,
        seed_start=DEMO_SEED_START,
        cameras=cameras,
        contract=describe_task(tasks[0], [camera.name for camera in cameras], state),
        features={name: feature for name, feature in features.items() if name in MEANINGS},
        meanings=MEANINGS
        | (ADVISED if "dagger" in facts or generator["labels"] == "advice" else {})
        | ({"action": MEANINGS["action"] + TURNS} if {*ROTATION} & {*tasks[0].action_names} else {})
        | ({"observation.state": MEANINGS["observation.state"] + FELT} if {*FORCE_NAMES} & {*state} else {}),
        sigma_mm=[round(float(value), 2) for value in sigma],
        rename_map=_rename_map([camera.key for camera in cameras]),
    )


IN_PI0 = {"base": "base_0_rgb", "wrist": "left_wrist_0_rgb"}
"""Our cameras and those of pi0's base models."""


def _rename_map(keys: list[str]) -> dict[str, str]:
    """Our cameras under the names that SmolVLA's and pi0's base models expect."""
    smolvla = {key: f"observation.images.camera{index + 1}" for index, key in enumerate(keys)}
    pi0 = {CAMERAS[name].key: f"observation.images.{theirs}" for name, theirs in IN_PI0.items()}
    return {"smolvla": json.dumps(smolvla), "pi0": json.dumps({key: pi0[key] for key in keys})}


def render_template(template: str, **facts: Any) -> str:
    """A template of this folder with its facts filled in, as text only: anybody may have written their files."""
    from jinja2 import Environment, StrictUndefined

    layout = {"trim_blocks": True, "lstrip_blocks": True}
    environment = Environment(undefined=StrictUndefined, autoescape=True, finalize=_plain, **layout)
    return environment.from_string(files(__package__).joinpath(template).read_text(encoding="utf-8")).render(**facts)


def _plain(value: Any) -> Any:
    return ACTIVE.sub(" ", value) if type(value) is str else value
