"""The episode: where it was run, what was executed and how it went, in memory and as a row of a Parquet file.

Where `$CONSTRUCTSKILL_RECORD` names a folder, every environment writes each of its finished episodes there, whatever
runs it: `lerobot-eval`, an evaluation harness, a loop of one's own. A study keeps its runs' episodes the same way.
"""

import hashlib
import json
import os
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from lerobot_constructskill.artifacts.code import code_of
from lerobot_constructskill.artifacts.digests import versions
from lerobot_constructskill.artifacts.folders import replaced
from lerobot_constructskill.artifacts.processor import make
from lerobot_constructskill.artifacts.tables import VERSIONS, Parquet
from lerobot_constructskill.contract import ANY_ACTION, FULL_ACTION, STAGES, TASK_ACTION, get_task, label_of
from lerobot_constructskill.perturbations import Perturbation

FOLDER = "CONSTRUCTSKILL_RECORD"
"""Environment variable: where to record."""

RECORDINGS = "recordings.parquet"
"""File of a study's run: the episodes that it executed."""

ENVIRONMENT = ("task", "episode_length", "perturb", "perturb_seed")
"""Arguments of `ConstructSkillEnv` that with a seed decide an episode's start and its end."""

STARTING = (*ENVIRONMENT, "obs_type")
"""`ENVIRONMENT`, and the observation that a policy is shown."""

OUTCOME = ("lifted", "placed", "stage", "lift_step", "place_step", "steps")
"""Fields of `Episode` that executing its actions again must reproduce."""

COUNTS = ("clipped_steps", "placements", "chain", "peak_force", "drops", "knocks", "collisions")
"""Entries of `info` about the episode so far, and fields of `Episode`."""

DECIDING = ("sapien", "mani_skill", "numpy", "torch")
"""Packages that decide what an action does; torch has a part in the controller's kinematics."""


def deciding() -> dict[str, str]:
    """Versions of `DECIDING`, our revisions, and the make of the processor, whose approximations PhysX uses."""
    return versions(*DECIDING) | code_of(__name__) | {"processor": make()}


@dataclass
class Episode:
    """One episode.

    Args:
        evaluation_seed: seed of the initial state.
        lifted: whether the object was lifted at any step.
        placed: whether it was placed at any step.
        stage: the furthest of `contract.STAGES` reached.
        lift_step, place_step: first step after which the object counted as lifted, as placed.
        steps: how many were executed.
        task, episode_length, perturb, perturb_seed: as of `ConstructSkillEnv`.
        obs_type: what the policy was shown.
        backend: what simulated and rendered, as `ConstructSkillEnv.backend`.
        versions: JSON, as `deciding` gives them.
        clipped_steps: how many of the actions were clipped; None if not counted.
        final_error_m: distance of the object from the goal's centre at the end, in metres; None if not measured.
        placements: how many of the task's placements were done at the end; None if not counted.
        chain: how many of them before the first that was not done, in the order of the task.
        measures: JSON, how the elements of a plan lie at the end, as `plans.measure` says; None without a plan.
        cost: sum of `info["cost"]`: what a step did that is unsafe, as counted below.
        peak_force: largest force between an object and another body at the end of a step, in newtons.
        drops: how often an object fell faster than 0.6 m/s.
        knocks: how often an object that was placed was moved from its place.
        collisions: steps after which the robot touched something with another link than its fingers.
        actions: every executed action in order, in pieces whose concatenation is (steps * A) float32, as
            `ConstructSkillEnv.step` takes them.
    """

    evaluation_seed: int
    lifted: bool = False
    placed: bool = False
    stage: str = STAGES[0]
    lift_step: int | None = None
    place_step: int | None = None
    steps: int = 0
    task: str = ""
    episode_length: int = 0
    perturb: str = ""
    perturb_seed: int = 0
    obs_type: str = ""
    backend: str = ""
    versions: str = "{}"
    clipped_steps: int | None = None
    final_error_m: float | None = None
    placements: int | None = None
    chain: int | None = None
    measures: str | None = None
    cost: float | None = None
    peak_force: float | None = None
    drops: int | None = None
    knocks: int | None = None
    collisions: int | None = None
    actions: list[np.ndarray] = field(default_factory=list)

    def add(self, action: np.ndarray, info: Mapping[str, Any]) -> None:
        """Add an executed action, (A,), and what the environment returned as `info` for it."""
        self.actions.append(np.array(action, dtype=np.float32))
        self.steps += 1
        for name in COUNTS:
            setattr(self, name, info[name])
        self.cost = (self.cost or 0.0) + info["cost"]
        if info["is_lifted"] and not self.lifted:
            self.lifted, self.lift_step = True, self.steps
        if info["is_success"] and not self.placed:  # a task may ask for more than the paper's placement
            self.placed, self.place_step = True, self.steps
        reached = ("lifted", self.lifted), ("in_bin", info["is_in_bin"]), ("placed", self.placed)
        self.stage = max([self.stage, *(stage for stage, is_reached in reached if is_reached)], key=STAGES.index)

    @property
    def outcome(self) -> dict[str, Any]:
        """The fields named in `OUTCOME`."""
        return {name: getattr(self, name) for name in OUTCOME}

    @property
    def environment(self) -> dict[str, Any]:
        """The fields named in `ENVIRONMENT`, and the form of the action where it is not the default."""
        acting = {} if self.action == TASK_ACTION else {"action": self.action}
        return {name: getattr(self, name) for name in ENVIRONMENT} | acting

    @property
    def action(self) -> str:
        """The form of its actions, one of `contract.ACTIONS`, as their length tells."""
        numbers = sum(map(len, self.actions))
        return ANY_ACTION if self.steps and numbers == len(FULL_ACTION) * self.steps else TASK_ACTION

    @property
    def flat(self) -> np.ndarray:
        """All actions, (steps * A,) float32."""
        return np.concatenate(self.actions) if self.actions else np.zeros(0, np.float32)

    @property
    def executed(self) -> np.ndarray:
        """All actions, (steps, A) float32."""
        return self.flat.reshape(-1, len(get_task(self.task, self.action).action_names))

    def write(self, folder: Path) -> None:
        """Write a file of its own, named by what is in it: an equal episode is the same file."""
        hashed = hashlib.sha256(self.flat.tobytes()).hexdigest()[:12]
        label = Perturbation(self.perturb, self.perturb_seed).label
        name = f"{label_of(self.task)}{label}-{self.episode_length}-{self.evaluation_seed}-{hashed}.parquet"
        write_recordings([self], folder / name)


ACTIONS = {list[np.ndarray]: pa.list_(pa.field("element", pa.float32(), nullable=False))}
"""Python's and Arrow's type of actions; `artifacts.tables` knows those of all other fields."""

MEASURED = ("placements", "chain", "measures", "cost", "peak_force", "drops", "knocks", "collisions")
"""Columns that older files lack."""

RECORDED = Parquet("a recording", Episode, ACTIONS, json={"versions": VERSIONS}, added=MEASURED)


def recorder(**facts: Any) -> Episode | None:
    """A new episode to record, if this process records; `facts` are fields of `Episode`."""
    return Episode(**facts, versions=json.dumps(deciding())) if os.environ.get(FOLDER) else None


def recording_into(folder: str | None, make: Callable[[], Any]) -> Any:
    """What `make` makes, in a process that records into `folder`, or not at all.

    A worker has the variables of the server that it is forked from, which are those of an earlier time.
    """
    os.environ.pop(FOLDER, None)
    if folder:
        os.environ[FOLDER] = folder
    return make()


def keep(recording: Episode) -> None:
    """Write a finished episode into the folder that `$CONSTRUCTSKILL_RECORD` names."""
    recording.write(Path(os.environ[FOLDER]))


def write_recordings(episodes: Iterable[Episode], path: Path, schema: pa.Schema = RECORDED.schema) -> None:
    """Write a Parquet file, which appears whole or not at all.

    Args:
        schema: columns of the file; each is a field of the episodes, and one of them is `actions`.
    """
    table = pa.Table.from_pylist([vars(one) | {"actions": one.flat} for one in episodes], schema=schema)
    # Split by byte, like bytes of neighbouring numbers stand together and compress.
    options = {"use_dictionary": False, "column_encoding": {"actions.list.element": "BYTE_STREAM_SPLIT"}}
    with replaced(path) as partial:
        pq.write_table(table, partial, compression="zstd", compression_level=19, **options)


def read_recordings(path: Path) -> list[Episode]:
    """Read a file of recordings.

    Raises:
        InputError: it holds something else.
    """
    return [Episode(**row) for row in to_rows(RECORDED.read(path))]


def to_rows(table: pa.Table) -> list[dict[str, Any]]:
    """The rows of a table of episodes: column to value, the actions of each as one array in a list."""
    actions = [[np.asarray(flat.values)] for flat in table["actions"]]
    rows = table.drop_columns("actions").to_pylist()
    return [row | {"actions": own} for row, own in zip(rows, actions, strict=True)]
