"""The rows of a study: one per evaluation episode, in one tidy parquet table. No torch, no simulator.

A run keeps its own episodes as `EpisodeRow`; the table of a study says of each which setting and variant it is, and
has one row for every run that failed or has not been made.
"""

from collections.abc import Iterable
from dataclasses import asdict, dataclass, fields
from pathlib import Path

import pandas as pd
import pyarrow as pa
import pyarrow.parquet as pq

from lerobot_constructskill.artifacts.folders import replaced
from lerobot_constructskill.artifacts.tables import with_later_columns
from lerobot_constructskill.errors import InputError, MissingError

STUDY, ROWS, PROVENANCE = "study.yaml", "rows.parquet", "provenance.json"
"""Files in a study's folder: the study as it was read, its rows, and what is known of how they were made."""

VARIANT, REFERENCE, SIGHTLESS = "variant", "reference", "sightless"
"""Roles: what is compared; a floor or ceiling; one of those that does not look at the scene."""

NOT_RUN = "not_run"
"""`error_kind` of a run that has not been made; any other kind is that of an exception (`errors.kind`)."""


def check_folder(root: Path) -> None:
    """Refuse what is not the folder of a study.

    Raises:
        MissingError: its file or its rows are not there.
    """
    for name in (STUDY, ROWS):
        if not (root / name).is_file():
            raise MissingError(f"'{root}' is not the folder of a study: {name} is missing.")


@dataclass(frozen=True, kw_only=True)
class EpisodeRow:
    """One evaluation episode, or one run without any.

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
    error_kind: str | None = None
    error: str | None = None
    dataset_sha256: str | None = None
    weights_sha256: str | None = None
    environment_sha256: str | None = None
    backend: str | None = None
    versions: str | None = None


@dataclass(frozen=True, kw_only=True)
class Row(EpisodeRow):
    """An episode's row in the table of a study.

    Args:
        setting: the study's setting.
        variant: the study's variant, or a reference such as "no_op".
        role: `VARIANT`, `REFERENCE` or `SIGHTLESS`.
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
    demonstrations: str | None = None
    heldout_mse_m2: float | None = None
    heldout_mse_m2_by_data: str | None = None
    video: str | None = None


_ARROW = {str: pa.string(), int: pa.int64(), float: pa.float64(), bool: pa.bool_()}


def _schema(kind: type) -> pa.Schema:
    return pa.schema([(field.name, _arrow_type(field.type)) for field in fields(kind)])


def _arrow_type(annotation: type) -> pa.DataType:
    return next(arrow for kind, arrow in _ARROW.items() if kind in getattr(annotation, "__args__", (annotation,)))


def write_rows(rows: Iterable[EpisodeRow], path: Path, kind: type[EpisodeRow] = Row) -> None:
    """Write `rows`, all of one `kind`, to a parquet file, which appears whole or not at all."""
    table = pa.Table.from_pylist([asdict(row) for row in rows], schema=_schema(kind))
    with replaced(path) as partial:
        pq.write_table(table, partial)


def read_rows(path: Path, kind: type[EpisodeRow] = Row) -> pd.DataFrame:
    """Read a parquet file of rows of one `kind`, with pandas' nullable types.

    Raises:
        InputError: the file does not hold such rows.
    """
    return _read(path, kind).to_pandas(types_mapper=_nullable)


def load_rows[Kind: EpisodeRow](path: Path, kind: type[Kind] = Row) -> list[Kind]:
    """Read the same as objects. Raises as `read_rows` does."""
    return [kind(**row) for row in _read(path, kind).to_pylist()]


def _read(path: Path, kind: type[EpisodeRow]) -> pa.Table:
    try:
        table = pq.read_table(path)
    except pa.ArrowInvalid as error:
        raise InputError(f"'{path}' cannot be read: {error}") from None
    table = with_later_columns(table, _schema(kind), ("clipped_steps",))
    if not table.schema.equals(_schema(kind)):
        raise InputError(f"'{path}' is not a table of a study's rows in this version's form.")
    return table


def _nullable(kind: pa.DataType):
    return {pa.int64(): pd.Int64Dtype(), pa.bool_(): pd.BooleanDtype(), pa.string(): pd.StringDtype()}.get(kind)
