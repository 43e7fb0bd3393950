"""The one table: tasks, cameras, action and state names, units and rates. Standard library only.

Every other room reads its numbers here, so a number that a data set, an environment, an expert and a policy
must agree on is written once. Geometry of a task's own assets stands in its scene file and reaches the experts
as privileged state.
"""

import re
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cache
from math import pi, sqrt
from typing import Any

from lerobot_constructskill.errors import InputError
from lerobot_constructskill.other_tasks import offered
from lerobot_constructskill.wordings import REWORDINGS

FPS = 20
"""Control rate in Hz: ManiSkill's default, and the frame rate of every data set."""

IMAGE_SIZE = 224
"""Height and width of every camera image, in pixels (paper, section II)."""

ACTION_SCALE = 0.1
"""Metres (and radians) that ManiSkill's normalised `pd_ee_delta_pose` calls 1.0."""

ROBOT_BASE = (-0.615, 0.0, 0.0)
"""Where the Panda stands in the world, in metres: ManiSkill's own default."""

SHOULDER_HEIGHT, WRIST_RADIUS, WRIST_HEIGHT = 0.333, 0.088, 0.2104
"""Of the Panda with its hand pointing down, in metres: the shoulder above the base, and the wrist above the TCP and
nearer to the base (Franka's kinematic parameters)."""

REACH = 0.66
"""Longest distance from shoulder to wrist in metres; 0.06 short of the stretched arm, near which IK fails."""


def highest_tcp(radius: float) -> float:
    """Height in metres that the TCP reaches with the hand pointing down, so far in metres from the base's axis."""
    return SHOULDER_HEIGHT - WRIST_HEIGHT + sqrt(max(0.0, REACH**2 - (radius - WRIST_RADIUS) ** 2))


GRIPPER_OPEN, GRIPPER_CLOSED = 1.0, -1.0

TCP_IN_HAND = (0.0, 0.0, 0.1034)
"""The end effector, which is the point between the fingertips, in the frame of the link `panda_hand`, in metres."""

TRANSLATION = ("dx", "dy", "dz")
"""End-effector displacement asked for in one step, in metres, in the robot's base frame."""

ROTATION = ("droll", "dpitch", "dyaw")
"""End-effector rotation asked for in one step, in radians, about the axes of the robot's base (right-handed)."""

ROTATION_SIGN = -1
"""ManiSkill's `pd_ee_delta_pose` takes rotations the other way round: it scales them by its lower bound."""

MOVED_SHARE = 0.4
"""Share of what a step asks for that the hand moves in it, because a target counts from where the hand is.

Measured by benchmarks/response.py. In y and z the first step after a rest moves half of that.
"""

GRIPPER = "gripper"
"""Last action channel, continuous: +1 open, -1 closed, in between as `FINGER_TARGETS` says."""

FULL_ACTION = (*TRANSLATION, *ROTATION, GRIPPER)
"""The channels that every task can be given, so that one policy has them all."""

ACTIONS = TASK_ACTION, ANY_ACTION = "task", "full"
"""The two forms of an action: the channels that the task's row names, or `FULL_ACTION`."""

FINGER_TARGETS = (-0.01, 0.04)
"""Position in metres that each finger is driven to at -1 and at +1, linear in between: at 0 it is 0.015 m."""

STATE_NAMES = ("ee_x", "ee_y", "ee_z", "ee_rx", "ee_ry", "ee_rz", "finger_left", "finger_right")
"""Proprioception: position in metres and axis-angle in radians in the robot's base frame, fingers in metres."""

FORCE_NAMES = ("force_x", "force_y", "force_z")
"""What pulls at the wrist at the end of the step before, in newtons, in the robot's base frame.

A force sensor between arm and hand shows the same once it is tared: the weight of what is held, what the hand presses
on, and a newton or two of the hand's own inertia.
"""

POSE = ("x", "y", "z", "qw", "qx", "qy", "qz")
"""A position in metres and a unit quaternion, w first."""

JOINTS = (*(f"panda_joint{number}" for number in range(1, 8)), "panda_finger_joint1", "panda_finger_joint2")
"""The Panda's seven arm joints, in rad and rad/s, and its two fingers, in m and m/s, as its URDF names them."""

FINGERS = ("panda_leftfinger", "panda_rightfinger")
"""The links of the two fingers."""

MAX_PLACEMENTS = 9
"""Most objects that one task places; the privileged state has room for so many in every task."""


def _each(*names: str) -> tuple[str, ...]:
    """`names` of every placement of a task, in order."""
    return tuple(f"{name}_{number}" for number in range(MAX_PLACEMENTS) for name in names)


SIM_STATE = {
    "tcp_pose": POSE,
    "fingers": ("finger_left", "finger_right"),
    "object_pose": POSE,
    "object_size": ("x", "y", "z"),
    "object_mass": ("mass",),
    "bin_position": ("x", "y", "z"),
    "bin_interior": ("x", "y", "z"),
    "joint_positions": JOINTS,
    "joint_velocities": JOINTS,
    "placement": ("number",),
    "object_poses": _each(*POSE),
    "object_sizes": _each("x", "y", "z"),
    "object_masses": _each("mass"),
    "bin_positions": _each("x", "y", "z"),
    "bin_interiors": _each("x", "y", "z"),
    "is_object": _each("is_object"),
    "is_placed": _each("is_placed"),
    "finger_forces": tuple(f"{side}_{axis}" for side in ("left", "right") for axis in "xyz"),
    "object_forces": _each("force"),
}
"""Privileged state, name to the names of its numbers: SI units, world frame.

A task is a list of placements. `object_*` and `bin_*` are of the next one, which is the first that is not done, or the
last of all; `placement` is its number. The plurals are of all placements, in order; `is_object` says which numbers
there are, the others are 0. Forces are those at the end of the step before, in newtons, without friction: the net
force on each finger, and the largest between each object and another body.
"""

PLURALS = {
    "object_pose": "object_poses",
    "object_size": "object_sizes",
    "object_mass": "object_masses",
    "bin_position": "bin_positions",
    "bin_interior": "bin_interiors",
}
"""Of `SIM_STATE`: what is said of the next placement, and of all."""

DEMO_SEED_START, DEMO_SEED_STOP = 1_000_000, 2**30
"""First seed of data sets, and the one after their last. LeRobot's evaluations start at the training seed or at 1000,
the board's at 5000, and its re-runs have all from the second number on."""

HELD_OUT_EVERY = 8
"""Size of the groups of demonstrations of which the last one is held out of training."""


TASK_NAME = "task_name"
"""Column of LeRobot's table of episodes in a set of several tasks, of which two may have one instruction."""


def held_out(episodes: int | Sequence[str], every: int = HELD_OUT_EVERY) -> list[int]:
    """Indices of the held-out demonstrations: of each task the last one of every whole group.

    Args:
        episodes: how many there are of the only task, or the task of each.
    """
    if isinstance(episodes, int):
        return list(range(every - 1, episodes, every))
    places: dict[str, list[int]] = {}
    for index, task in enumerate(episodes):
        places.setdefault(task, []).append(index)
    return sorted(index for own in places.values() for index in own[every - 1 :: every])


STAGES = ("none", "lifted", "in_bin", "placed")
"""How far an episode came, in order."""

REWARD_LIFTED, REWARD_PLACED = 0.5, 1.0
"""The reward of a step is the stage its episode has reached; 0 before the object is lifted."""


@dataclass(frozen=True)
class Camera:
    """A camera of the contract.

    Args:
        name: the camera's part in `observation.images.<name>`.
        fov: vertical field of view in radians.
        eye: position in the world in metres, or in the frame of `mount` where one is named.
        target: the world point looked at, in metres; unused by a mounted camera.
        mount: the robot link that carries the camera, or None for a fixed one.
    """

    name: str
    fov: float
    eye: tuple[float, float, float]
    target: tuple[float, float, float] | None = None
    mount: str | None = None

    @property
    def key(self) -> str:
        return f"observation.images.{self.name}"


CAMERAS = {
    camera.name: camera
    for camera in (
        Camera("base", fov=pi / 2, eye=(-1.0, -1.3, 0.9), target=(0.0, -0.35, 0.2)),
        Camera("wrist", fov=pi / 2, eye=(0.0464982, -0.0200011, 0.0360011), mount="panda_hand"),
    )
}

OBS_TYPES = {"pixels": ("base",), "pixels_agent_pos": ("base", "wrist"), "pixels_agent_pos_force": ("base", "wrist")}
"""Cameras of each `obs_type`, from the one that shows least; all but `pixels` show the state as well."""


def state_names(obs_type: str) -> tuple[str, ...]:
    """Channels of the state: `STATE_NAMES`, and the force where `obs_type` asks for it."""
    return (*STATE_NAMES, *FORCE_NAMES) if obs_type == "pixels_agent_pos_force" else STATE_NAMES


LADDER = {f"brick_to_bin_{mm}mm": mm / 1000 for mm in (40, 20, 10, 5, 3)}
"""The tolerance ladder: task name to the total clearance in x and in y, in metres."""

LADDER_YIELDS = {"brick_to_bin_5mm": 0.3, "brick_to_bin_3mm": 0.1}
"""`noisy_yield` of the tightest bins, where noise turns the brick between the fingers: 24 of 40 attempts succeeded at
5 mm and 15 of 40 at 3 mm."""

ORDERS = {f"{item}_to_{colour}": (item, colour) for item in ("brick", "block") for colour in ("grey", "blue")}
"""Tasks that only the instruction tells apart: name to the object and the bin that it asks for."""

SUITES = {
    "bins": ("brick_to_bin", "brick_to_bin_shifted", "block_to_bin"),
    "ladder": tuple(LADDER),
    "joints": ("brick_on_brick", "tile_to_grid", "tenon_to_mortise"),
    "orders": tuple(ORDERS),
    "wall": ("course_of_three", "bond_of_five", "lintel_on_posts"),
}
"""Suite name to its tasks; the tasks of one suite share their action."""

PLANNED = "plan:"
"""Before the name or file of a plan, where a task is asked for: the wall of that plan."""

FIELDS = {
    "name": f"it is lower-case letters, digits and underscores, and none of the suites {', '.join(SUITES)}",
    "horizon": "it is a whole number of steps from 1 on",
    "scene": "it is module:class",
    "expert": "it is module:class",
    "action_names": f"they are {', '.join(TRANSLATION)}, some of {', '.join(ROTATION)}, and {GRIPPER} last",
}
"""The rule of each checked field of a task, for messages."""


@dataclass(frozen=True)
class Task:
    """One row of the table.

    Args:
        name: what `--env.task` takes.
        env_id: the ManiSkill environment id.
        instruction: the sentence in the data set's `task` and the environment's `task_description`.
        horizon: default length of an evaluation episode, in steps.
        scene: `module:class` of the ManiSkill environment.
        expert: `module:class` of the scripted expert.
        action_names: channels of `action`, translations (and rotations) first, the gripper last.
        noisy_yield: share of demonstrations under the default noise that succeed at least; the others are discarded,
            and a data set of a task below 0.5 needs a larger `max_failures`.
        is_brick: the object is a brick, whose size can be perturbed.
        plan: the plan after which several objects are placed, a name in `configs/plan`; none where there is one.
        rewordings: other sentences that mean the same: those to train with, then those that are never trained with, by
            level of the axis `language`.
    """

    name: str
    env_id: str
    instruction: str
    horizon: int
    scene: str
    expert: str
    action_names: tuple[str, ...] = (*TRANSLATION, GRIPPER)
    noisy_yield: float = 0.9
    is_brick: bool = False
    plan: str | None = None
    rewordings: tuple[tuple[str, ...], ...] = ()

    def __post_init__(self):
        wrong = {
            "name": not re.fullmatch(rf"[a-z0-9_]+|{PLANNED}.+", str(self.name)) or self.name in SUITES,
            "horizon": not isinstance(self.horizon, int) or self.horizon < 1,
            "scene": not re.fullmatch(r"[\w.]+:\w+", str(self.scene)),
            "expert": not re.fullmatch(r"[\w.]+:\w+", str(self.expert)),
            "action_names": self.action_names[-1:] != (GRIPPER,)
            or not {*TRANSLATION} <= {*self.action_names} <= {*TRANSLATION, *ROTATION, GRIPPER},
        }
        if field := next((name for name, is_wrong in wrong.items() if is_wrong), None):
            raise InputError(f"The task {self.name!r} cannot have {field} {getattr(self, field)!r}: {FIELDS[field]}.")


_PICK_PLACE = "lerobot_constructskill.demos.pick_place:PickPlaceExpert"
_PRECISE = "lerobot_constructskill.demos.precise:PreciseExpert"
_TURNING = "lerobot_constructskill.demos.precise:TurningExpert"
_LAYING = "lerobot_constructskill.demos.laying:LayingExpert"
_SCENES = "lerobot_constructskill.sim.tasks"

BRICK = (0.21, 0.065, 0.10)
"""Size of the paper's brick as it stands, in metres: Waaldickformat, on its long narrow face."""

SHIPPED = {
    task.name: replace(task, rewordings=REWORDINGS[task.instruction])
    for task in (
        Task(
            name="brick_to_bin",
            env_id="ConstructionPickPlace-ViT-v1",
            instruction="Pick up the brick and place it in the bin.",
            horizon=700,
            scene=f"{_SCENES}.brick:BrickToBinEnv",
            expert=_PICK_PLACE,
            is_brick=True,
        ),
        Task(
            name="brick_to_bin_shifted",
            env_id="ConstructionPickPlaceShifted-v1",
            instruction="Pick up the brick and place it in the bin.",
            horizon=700,
            scene=f"{_SCENES}.brick:BrickToBinShiftedEnv",
            expert=_PICK_PLACE,
            is_brick=True,
        ),
        Task(
            name="block_to_bin",
            env_id="ConstructionBlockPickPlace-v1",
            instruction="Pick up the concrete block and place it in the bin.",
            horizon=700,
            scene=f"{_SCENES}.block:BlockToBinEnv",
            expert=_PICK_PLACE,
        ),
        *(
            Task(
                name=name,
                env_id=f"ConstructionBrickLadder{clearance * 1000:.0f}mm-v1",
                instruction="Pick up the brick and set it down in the close-fitting bin.",
                horizon=400,
                scene=f"{_SCENES}.brick:BrickLadderEnv",
                expert=_PRECISE,
                noisy_yield=LADDER_YIELDS.get(name, 0.9),
                is_brick=True,
            )
            for name, clearance in LADDER.items()
        ),
        Task(
            name="brick_to_bin_turned",
            env_id="ConstructionPickPlaceTurned-v1",
            instruction="Turn the gripper to the brick, pick it up and place it in the bin.",
            horizon=500,
            scene=f"{_SCENES}.brick:BrickToBinTurnedEnv",
            expert=_TURNING,
            action_names=(*TRANSLATION, "dyaw", GRIPPER),
            is_brick=True,
        ),
        Task(
            name="brick_on_brick",
            env_id="ConstructionBrickOnBrick-v1",
            instruction="Pick up the brick and set it flush on top of the other brick.",
            horizon=400,
            scene=f"{_SCENES}.brick:BrickOnBrickEnv",
            expert=_PRECISE,
            is_brick=True,
        ),
        Task(
            name="tile_to_grid",
            env_id="ConstructionTileToGrid-v1",
            instruction="Take the ceiling tile by its lifter and lay it into the opening of the grid.",
            horizon=400,
            scene=f"{_SCENES}.tile:TileToGridEnv",
            expert=_PRECISE,
        ),
        Task(
            name="tenon_to_mortise",
            env_id="ConstructionTenonToMortise-v1",
            instruction="Pick up the timber post and set its tenon into the mortise of the sill.",
            horizon=400,
            scene=f"{_SCENES}.tenon:TenonToMortiseEnv",
            expert=_PRECISE,
        ),
        *(
            Task(
                name=name,
                env_id=f"ConstructionOrder{item.title()}{colour.title()}-v1",
                instruction=f"Put the {item} into the {colour} bin.",
                horizon=300,
                scene=f"{_SCENES}.order:OrderEnv",
                expert=_PICK_PLACE,
            )
            for name, (item, colour) in ORDERS.items()
        ),
        *(
            Task(
                name=name,
                env_id=f"Construction{''.join(part.title() for part in name.split('_'))}-v1",
                instruction=instruction,
                horizon=horizon,
                scene=f"{_SCENES}.wall:WallEnv",
                expert=_LAYING,
                noisy_yield=0.6,
                plan=name,
            )
            for name, horizon, instruction in (
                ("course_of_three", 1200, "Lay the three bricks end to end, with joints of ten millimetres."),
                ("bond_of_five", 2000, "Lay three bricks end to end and the other two on their joints."),
                ("lintel_on_posts", 1200, "Set up the two posts and lay the beam across them."),
            )
        ),
    )
}
"""The rows of this package, by name."""

PLAN_TASK = replace(
    SHIPPED["course_of_three"],
    env_id="ConstructionPlan-v1",
    instruction=(_BUILD := "Build the wall after its plan."),
    rewordings=REWORDINGS[_BUILD],
    horizon=400 * MAX_PLACEMENTS,
)
"""The row of any other plan, which is named by the task: `plan:NAME_OR_FILE`."""

TASKS: dict[str, Task]
"""All rows, by name: those of this package, then those that other installed packages offer."""


@cache
def _all_tasks() -> dict[str, Task]:
    tasks = dict(SHIPPED)
    owners = {key: "lerobot_constructskill" for task in SHIPPED.values() for key in (task.name, task.env_id)}
    for package, task in offered(Task):
        for key in (task.name, task.env_id):
            if key in owners and tasks.get(task.name) != task:
                raise InputError(
                    f"The packages '{owners[key]}' and '{package}' both have a task '{key}': uninstall one, or give "
                    "its task another name and env_id."
                )
        tasks[task.name] = task
        owners |= dict.fromkeys((task.name, task.env_id), package)
    return tasks


def __getattr__(name: str) -> Any:
    # Other packages import this module for `Task`. So their rows are read on first use, when all imports are through.
    if name == "TASKS":
        return _all_tasks()
    raise AttributeError(f"module '{__name__}' has no attribute '{name}'")


def label_of(task: str) -> str:
    """A task's name as it can stand in the name of a file, where that of a plan may be a path."""
    return re.sub(r"[^\w.-]", "_", task)


def get_task(name: str, action: str = TASK_ACTION) -> Task:
    """Return the row called `name`.

    Args:
        action: one of `ACTIONS`; in the full form the row names all channels.

    Raises:
        ValueError: there is no such task; the message lists those there are.
    """
    tasks = _all_tasks()
    if name.startswith(PLANNED) and name != PLANNED:
        row = replace(PLAN_TASK, name=name, plan=name.removeprefix(PLANNED))
    elif name in SUITES:
        raise InputError(f"'{name}' is a suite, and one task is asked for: {', '.join(SUITES[name])}.")
    elif name not in tasks:
        raise InputError(f"Unknown task '{name}'; the tasks are: {', '.join(tasks)}; and {PLANNED}NAME_OR_FILE.")
    else:
        row = tasks[name]
    return replace(row, action_names=FULL_ACTION) if action == ANY_ACTION else row


LOOSE = "constructskill"
"""Name under which the results of tasks that were chosen one by one are kept."""


def list_tasks(names: str, action: str = TASK_ACTION) -> list[Task]:
    """The rows that `names` asks for, in its order. Arguments and errors are those of `select_tasks`."""
    return [row for suite in select_tasks(names, action).values() for row in suite]


def select_tasks(names: str, action: str = TASK_ACTION) -> dict[str, list[Task]]:
    """The rows that `names` asks for, by suite.

    Args:
        names: a task, a suite, or several of them with commas between.
        action: as of `get_task`.

    Raises:
        ValueError: a name is neither a task nor a suite, is given twice, or the tasks differ in their action.
    """
    selected: dict[str, list[Task]] = {}
    for name in (part.strip() for part in names.split(",")):
        suite, members = (name, SUITES[name]) if name in SUITES else (LOOSE, (name,))
        if suite == LOOSE and name not in _all_tasks() and not name.startswith(PLANNED):
            tasks, suites = ", ".join(_all_tasks()), ", ".join(SUITES)
            raise InputError(
                f"Unknown task '{name}'; the tasks are: {tasks}; the suites: {suites}; and {PLANNED}NAME_OR_FILE."
            )
        selected.setdefault(suite, []).extend(get_task(member, action) for member in members)
    rows = [row for suite in selected.values() for row in suite]
    if len(set(rows)) < len(rows):
        raise InputError(f"'{names}' names a task twice; name each once.")
    if len({row.action_names for row in rows}) > 1:
        raise InputError(
            f"'{names}' mixes tasks whose actions differ; choose tasks that share {rows[0].action_names}, or "
            f"action={ANY_ACTION}, which gives every task {len(FULL_ACTION)} numbers."
        )
    return selected
