"""What was executed in an environment and what came of it: a row an episode, so that anyone can execute it again.

Where `$CONSTRUCTSKILL_RECORD` names a folder, every environment writes each of its finished episodes there, whatever
runs it: `lerobot-eval`, an evaluation harness, a loop of one's own. A study keeps its runs' episodes the same way.
"""

import hashlib
import json
import os
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field, fields
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
from lerobot_constructskill.contract import STAGES
from lerobot_constructskill.perturbations import Perturbation

FOLDER = "CONSTRUCTSKILL_RECORD"
"""Environment variable: where to record."""

RECORDINGS = "recordings.parquet"
"""Where a study's run keeps what it executed."""

STARTING = ("task", "episode_length", "perturb", "perturb_seed", "obs_type")
"""Arguments of `ConstructSkillEnv` that with a seed decide an episode's start, its end and what a policy is shown."""

DECIDING = ("sapien", "mani_skill", "numpy", "torch")
"""Packages that decide what an action does; torch has a part in the controller's kinematics."""


def deciding() -> dict[str, str]:
    """Their versions here, our revisions, and the make of the processor: PhysX computes with its approximations."""
    return versions(*DECIDING) | code_of(__name__) | {"processor": make()}


@dataclass
class Outcome:
    """How an episode went; the fields are those of `rows.EpisodeRow`."""

    evaluation_seed: int
    lifted: bool = False
    placed: bool = False
    stage: str = STAGES[0]
    lift_step: int | None = None
    place_step: int | None = None
    steps: int = 0

    def count(self, info: Mapping[str, Any]) -> None:
        """Count one step, of which the environment said `info`."""
        self.steps += 1
        if info["is_lifted"] and not self.lifted:
            self.lifted, self.lift_step = True, self.steps
        if info["is_success"] and not self.placed:  # a task may ask for more than the paper's placement
            self.placed, self.place_step = True, self.steps
        reached = ("lifted", self.lifted), ("in_bin", info["is_in_bin"]), ("placed", self.placed)
        self.stage = max([self.stage, *(stage for stage, is_reached in reached if is_reached)], key=STAGES.index)


@dataclass
class Recording(Outcome):
    """An episode's outcome, where it was had, and its actions.

    Args:
        task, episode_length, perturb, perturb_seed: as of `ConstructSkillEnv`; with the seed they decide its start.
        obs_type: what the policy was shown.
        backend: what simulated and rendered, as `ConstructSkillEnv.backend`.
        versions: JSON, as `deciding` gives them.
        clipped_steps: how many of the actions were clipped; None where nobody counted.
        actions: every executed action, one after another, (steps * A) float32 as `ConstructSkillEnv.step` takes them.
    """

    task: str = ""
    episode_length: int = 0
    perturb: str = ""
    perturb_seed: int = 0
    obs_type: str = ""
    backend: str = ""
    versions: str = field(default_factory=lambda: json.dumps(deciding()))
    clipped_steps: int | None = None
    actions: list[np.ndarray] = field(default_factory=list)

    def add(self, action: np.ndarray, info: Mapping[str, Any]) -> None:
        """Keep a copy of an executed action, (A,), and count what came of it."""
        self.actions.append(np.array(action, dtype=np.float32))
        self.count(info)
        self.clipped_steps = info["clipped_steps"]

    @classmethod
    def of(cls, outcome: Outcome, actions: list[np.ndarray], **facts: Any) -> "Recording":
        """The recording of an episode that has ended; `facts` are the other fields of `Recording`."""
        went = {one.name: getattr(outcome, one.name) for one in fields(Outcome)}
        clipped = getattr(outcome, "clipped_steps", None)  # a submission's claim has no such field
        return cls(**went, clipped_steps=clipped, actions=actions, **facts)

    @property
    def flat(self) -> np.ndarray:
        """All actions, (steps * A,) float32."""
        return np.concatenate(self.actions) if self.actions else np.zeros(0, np.float32)

    def write(self, folder: Path) -> Path:
        """Write a file of its own, named by what is in it: an equal episode is the same file."""
        said = hashlib.sha256(self.flat.tobytes()).hexdigest()[:12]
        label = Perturbation(self.perturb, self.perturb_seed).label
        path = folder / f"{self.task}{label}-{self.episode_length}-{self.evaluation_seed}-{said}.parquet"
        write_recordings([self], path)
        return path


ACTIONS = pa.list_(pa.field("element", pa.float32(), nullable=False))

TABLE = Parquet(
    "a recording", Recording, {list[np.ndarray]: ACTIONS}, later=("clipped_steps",), json={"versions": VERSIONS}
)


def compressed(actions: str) -> dict[str, Any]:
    """How Parquet is to write a column of `ACTIONS`: like bytes of neighbouring numbers stand together."""
    leaf = f"{actions}.list.element"
    split = {"use_dictionary": False, "column_encoding": {leaf: "BYTE_STREAM_SPLIT"}}
    return {"compression": "zstd", "compression_level": 19, **split}


def recorder(**facts: Any) -> Recording | None:
    """A new recording, if this process records; `facts` are fields of `Recording`."""
    return Recording(**facts) if os.environ.get(FOLDER) else None


def recording_into(folder: str | None, make: Callable[[], Any]) -> Any:
    """What `make` makes, in a process that records into `folder`, or not at all.

    A worker has the variables of the server that it is forked from, which are those of an earlier time.
    """
    os.environ.pop(FOLDER, None)
    if folder:
        os.environ[FOLDER] = folder
    return make()


def keep(recording: Recording | None) -> None:
    """Write a finished recording into the folder that is named."""
    if recording is not None:
        recording.write(Path(os.environ[FOLDER]))


def write_recordings(recordings: Iterable[Recording], path: Path) -> None:
    """Write a parquet file, which appears whole or not at all."""
    rows = [vars(each) | {"actions": each.flat} for each in recordings]
    with replaced(path) as partial:
        pq.write_table(pa.Table.from_pylist(rows, schema=TABLE.schema), partial, **compressed("actions"))


def read_recordings(path: Path) -> list[Recording]:
    """Read a file of recordings of one's own.

    Raises:
        InputError: it holds something else.
    """
    table = TABLE.read(path)
    flat = [np.asarray(actions.values) for actions in table["actions"]]
    rows = table.drop_columns("actions").to_pylist()
    return [Recording(**row, actions=[actions]) for row, actions in zip(rows, flat, strict=True)]
