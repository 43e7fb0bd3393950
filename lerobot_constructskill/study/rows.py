"""The rows of a study: one per evaluation episode, in one tidy Parquet table. Imports neither torch nor a simulator.

A run keeps its episodes as `EpisodeRow`. The table of a study holds `Row`, which adds the setting and the variant, and
has one row for every run that failed or has not been made.
"""

from collections.abc import Iterable, Mapping
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Annotated, Any, Literal, NotRequired, TypedDict

import pandas as pd
import pyarrow as pa
import pyarrow.parquet as pq
from annotated_types import Ge, Lt

from lerobot_constructskill.artifacts.folders import replaced
from lerobot_constructskill.artifacts.tables import VERSIONS, Parquet
from lerobot_constructskill.envs.recording import MEASURED, Episode
from lerobot_constructskill.errors import InputError, MissingError
from lerobot_constructskill.files import Json, Yaml

STUDY, ROWS, PROVENANCE = "study.yaml", "rows.parquet", "provenance.json"
"""Files in a study's folder: the study as it was read, its rows, and facts about how they were made."""

VARIANT, REFERENCE, SIGHTLESS = "variant", "reference", "sightless"
"""Roles: what is compared; a floor or ceiling; a floor or ceiling that does not look at the scene."""

NOT_RUN = "not_run"
"""`error_kind` of a run that has not been made; any other kind is that of an exception (`errors.kind`)."""

ERRORS = Json("held-out errors in m2, data set to error", dict[str, float])


WALL_TIME = "wall time, s"
"""Entry of `PROVENANCE`: how long the sessions of a study took, added up."""

_Known = TypedDict("_Known", {"machine": str, WALL_TIME: Annotated[float, Ge(0), Lt(float("inf"))]}, total=False)

KNOWN = Json("what is known of a study's making", _Known)
"""Of the file `PROVENANCE`."""


class _Env(TypedDict):
    task: str
    episode_length: NotRequired[Annotated[int, Ge(1)] | None]
    obs_type: NotRequired[str]
    perturb: NotRequired[str]
    perturb_seed: NotRequired[int]


class _Environment(TypedDict):
    env: _Env


SHARED, OWN = "shared", "own"
"""Whether all training seeds learn from the same demonstrations, or each draw has its own; of starts likewise."""


@dataclass(frozen=True)
class Draws:
    """Which training seeds of a study share demonstrations, and starts.

    Args:
        demonstrations: `SHARED` by all training seeds, or each draw's `OWN`.
        starts: the same of the starts.
        seeds_a_draw: training seeds that share a draw.
    """

    demonstrations: str = SHARED
    starts: str = SHARED
    seeds_a_draw: int = 1

    def of(self, seed: int) -> int:
        """The draw that a training seed learns from; 0 where all share one."""
        return seed // self.seeds_a_draw if self.demonstrations == OWN else 0

    def unit(self, seed: int) -> int:
        """What counts once: a training seed, or its draw of demonstrations where there are several."""
        return self.of(seed) if self.demonstrations == OWN else seed

    @property
    def groups_seeds(self) -> bool:
        """Whether there are several draws of demonstrations, each for several training seeds."""
        return self.demonstrations == OWN and self.seeds_a_draw > 1

    @property
    def covered(self) -> str:
        """What intervals over the study's runs hold for."""
        if self.demonstrations == SHARED:
            return "other training seeds, with the same demonstrations and starts"
        if self.starts == SHARED:
            return "other draws of demonstrations and other training seeds, from the same starts"
        return "other draws of demonstrations, other starts and other training seeds"


class _Means(TypedDict):
    means: NotRequired[dict[str, list[str]]]


class _Settings(TypedDict):
    settings: dict[str, _Environment]
    analysis: NotRequired[_Means | None]
    demonstrations: NotRequired[Literal["shared", "own"]]
    starts: NotRequired[Literal["shared", "own"]]
    seeds_a_draw: NotRequired[Annotated[int, Ge(1)]]


SETTINGS = Yaml("a study's file", _Settings)


def merged(versions: Iterable[Mapping[str, Any]]) -> dict[str, str]:
    """The packages, rooms and processors of several rows by name, each with all its different versions."""
    found: dict[str, set[str]] = {}
    for one in versions:
        for name, version in one.items():
            found.setdefault(name, set()).add(str(version))
    return {name: ", ".join(sorted(found[name])) for name in sorted(found)}


def read_environments(root: Path) -> dict[str, dict[str, Any]]:
    """Read where each setting of a study's folder is evaluated: fields of `--env.type=constructskill`, by setting.

    Raises:
        InputError: its file is not a study's.
    """
    return {name: of["env"] for name, of in SETTINGS.read(root / STUDY)["settings"].items()}


def read_means(root: Path) -> dict[str, list[str]]:
    """Read what a study's folder takes means over: name to settings, `analysis.means`. Raises as `read_draws` does."""
    return (SETTINGS.read(root / STUDY).get("analysis") or {}).get("means", {})


def read_draws(root: Path) -> Draws:
    """Read which training seeds of a study's folder share demonstrations and starts.

    Raises:
        InputError: its file is not a study's.
    """
    study = SETTINGS.read(root / STUDY)
    return Draws(study.get("demonstrations", SHARED), study.get("starts", SHARED), study.get("seeds_a_draw", 1))


def check_folder(root: Path) -> None:
    """Refuse a folder that is not a study's.

    Raises:
        MissingError: its file or its rows are not there.
    """
    for name in (STUDY, ROWS):
        if not (root / name).is_file():
            raise MissingError(f"'{root}' is not the folder of a study: {name} is missing.")


@dataclass(frozen=True, kw_only=True)
class EpisodeRow:
    """One evaluation episode, or one run without any. Columns named as fields of `Episode` have their meaning.

    Args:
        run: digest of the run's specification; null for runs made before runs had one.
        training_seed: seed of the training run (of a reference: of its own randomness).
        evaluation_seed: seed of the episode's initial state.
        episode: 0, 1, ... within the run.
        lifted: whether the object was lifted at any step; null where the run failed.
        placed: whether it was placed at any step; null where the run failed.
        stage: the furthest of `contract.STAGES` reached.
        lift_step: first step after which the object counted as lifted.
        place_step: first step after which it counted as placed.
        final_error_m: distance of the object from the goal's centre at the end, in metres.
        steps: length of the episode.
        clipped_steps: how many of its actions asked for more than the controller gives; null in rows from before these
            were counted.
        placements, chain, measures, cost, peak_force, drops, knocks, collisions: null in older rows.
        error_kind: null where the run finished; `NOT_RUN`, or what kind of failure: "weights" (of a backbone, to be
            had nowhere), "input", "missing", "taken", "machine" or "fault". Such a run has one row, episode 0.
        error: why the run failed, one sentence.
        dataset_sha256: hash of the demonstrations; null for a reference that uses none.
        weights_sha256: hash of the policy's weights.
        environment_sha256: hash of the environment's configuration.
        backend: what rendered and simulated, such as "physx_cpu, cpu rendering".
        versions: JSON, package to version, and the processor (and the graphics card, if one was used) that made
            the row.
    """

    run: str | None
    training_seed: int
    evaluation_seed: int
    episode: int
    lifted: bool | None = None
    placed: bool | None = None
    stage: str | None = None
    lift_step: int | None = None
    place_step: int | None = None
    final_error_m: float | None = None
    steps: int | None = None
    clipped_steps: int | None = None
    placements: int | None = None
    chain: int | None = None
    measures: str | None = None
    cost: float | None = None
    peak_force: float | None = None
    drops: int | None = None
    knocks: int | None = None
    collisions: int | None = None
    error_kind: str | None = None
    error: str | None = None
    dataset_sha256: str | None = None
    weights_sha256: str | None = None
    environment_sha256: str | None = None
    backend: str | None = None
    versions: str | None = None

    def filled(self, episode: Episode, number: int) -> "EpisodeRow":
        """This row with the outcome of an episode, which has this number within the run."""
        measured = {name: getattr(episode, name) for name in ("final_error_m", "clipped_steps", *MEASURED)}
        return replace(self, evaluation_seed=episode.evaluation_seed, episode=number, **episode.outcome, **measured)


@dataclass(frozen=True, kw_only=True)
class Row(EpisodeRow):
    """An episode's row in the table of a study.

    Args:
        setting: the study's setting.
        variant: the study's variant, or a reference such as "no_op".
        role: `VARIANT`, `REFERENCE` or `SIGHTLESS`.
        task: a name in `contract.TASKS`, or a plan; null in older rows, and so is the next one.
        instruction: the sentence that the policy was told.
        episodes: how many evaluation episodes the run has, or is to have.
        demonstrations: name of the data set that it was trained on; null for a reference that uses none.
        heldout_mse_m2: the run's translation error on the setting's held-out demonstrations, in m2.
        heldout_mse_m2_by_data: JSON, the same on every data set of the setting, by name.
        video: path of a video of the episode in the study's folder.
    """

    setting: str
    variant: str
    role: str
    episodes: int
    task: str | None = None
    instruction: str | None = None
    demonstrations: str | None = None
    heldout_mse_m2: float | None = None
    heldout_mse_m2_by_data: str | None = None
    video: str | None = None


TABLES = {
    EpisodeRow: Parquet("a table of a run's rows", EpisodeRow, json={"versions": VERSIONS}, added=MEASURED),
    Row: Parquet(
        "a table of a study's rows",
        Row,
        json={"versions": VERSIONS, "heldout_mse_m2_by_data": ERRORS},
        added=(*MEASURED, "task", "instruction"),
    ),
}

NULLABLE = {pa.int64(): pd.Int64Dtype(), pa.bool_(): pd.BooleanDtype(), pa.string(): pd.StringDtype()}
"""Arrow's types and those of pandas that hold null as well."""


def write_rows(rows: Iterable[EpisodeRow], path: Path, kind: type[EpisodeRow] = Row) -> None:
    """Write `rows`, all of one `kind`, to a parquet file, which appears whole or not at all."""
    table = pa.Table.from_pylist([asdict(row) for row in rows], schema=TABLES[kind].schema)
    with replaced(path) as partial:
        pq.write_table(table, partial)


def read_rows(path: Path, kind: type[EpisodeRow] = Row) -> pd.DataFrame:
    """Read a parquet file of rows of one `kind`, with pandas' nullable types.

    Raises:
        InputError: the file does not hold such rows.
    """
    rows = TABLES[kind].read(path).to_pandas(types_mapper=NULLABLE.get)
    if kind is Row and (wrong := {*rows["role"]} - {VARIANT, REFERENCE, SIGHTLESS}):
        raise InputError(f"'{path}' is not {TABLES[kind].what}: there is no role {min(wrong)!a}.")
    if kind is Row and (rows["episodes"] < 1).any():
        raise InputError(f"'{path}' is not {TABLES[kind].what}: a run must have one episode or more.")
    return rows


def ran(rows: pd.DataFrame) -> pd.DataFrame:
    """Those rows whose runs were made, also if they failed."""
    return rows[rows["error_kind"].fillna("") != NOT_RUN]


def load_rows[Kind: EpisodeRow](path: Path, kind: type[Kind] = Row) -> list[Kind]:
    """Read the same as objects. Raises as `read_rows` does."""
    return [kind(**row) for row in TABLES[kind].read(path).to_pylist()]
