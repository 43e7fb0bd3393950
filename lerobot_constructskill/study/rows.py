"""The rows of a study: one per evaluation episode, in one tidy parquet table. No torch, no simulator."""

from collections.abc import Iterable
from dataclasses import asdict, dataclass, fields
from pathlib import Path

import pandas as pd
import pyarrow as pa
import pyarrow.parquet as pq

from lerobot_constructskill.errors import InputError
from lerobot_constructskill.staging import replaced

STAGES = ("none", "lifted", "in_bin", "placed")
"""How far an episode came, in order."""


@dataclass(frozen=True)
class Row:
    """One evaluation episode, or one run that failed.

    Args:
        plan_sha256: hash of the study's plan.
        setting: the plan's setting.
        variant: the plan's variant, or a reference such as "no_op".
        is_reference: whether `variant` is a floor or ceiling.
        training_seed: seed of the training run (of a reference: of its own randomness).
        evaluation_seed: seed of the episode's initial state.
        episode: 0, 1, ... within the run.
        lifted: whether the object was lifted at any step; null where the run failed.
        placed: whether it was placed at any step; null where the run failed.
        stage: the furthest of `STAGES` reached.
        lift_step: first step after which the object counted as lifted.
        place_step: first step after which it counted as placed.
        final_error_m: distance of the object from the goal's centre at the end, in metres.
        steps: length of the episode.
        heldout_mse_m2: the run's translation error on the setting's held-out demonstrations, in m2.
        heldout_mse_m2_by_data: JSON, the same on every configuration of demonstrations in the setting.
        error: why the run failed, one sentence; null where it finished. A failed run has one row, episode 0.
        dataset_sha256: hash of the demonstrations; null for a reference that uses none.
        weights_sha256: hash of the policy's weights.
        environment_sha256: hash of the environment's configuration.
        backend: what rendered and simulated, such as "physx_cpu, cpu rendering".
        versions: JSON, package to version.
        video: path of a video of the episode in the study's folder.
    """

    plan_sha256: str
    setting: str
    variant: str
    is_reference: bool
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
    heldout_mse_m2: float | None = None
    heldout_mse_m2_by_data: str | None = None
    error: str | None = None
    dataset_sha256: str | None = None
    weights_sha256: str | None = None
    environment_sha256: str | None = None
    backend: str | None = None
    versions: str | None = None
    video: str | None = None


_ARROW = {str: pa.string(), int: pa.int64(), float: pa.float64(), bool: pa.bool_()}


def _arrow_type(annotation: type) -> pa.DataType:
    return next(arrow for kind, arrow in _ARROW.items() if kind in getattr(annotation, "__args__", (annotation,)))


SCHEMA = pa.schema([(field.name, _arrow_type(field.type)) for field in fields(Row)])


def write_rows(rows: Iterable[Row], path: Path) -> None:
    """Write `rows` to a parquet file, which appears whole or not at all."""
    table = pa.Table.from_pylist([asdict(row) for row in rows], schema=SCHEMA)
    with replaced(path) as partial:
        pq.write_table(table, partial)


def read_rows(*paths: Path) -> pd.DataFrame:
    """Read parquet files of rows into one table, pandas' nullable types, in the order given.

    Raises:
        ValueError: a file does not hold rows of a study.
    """
    return _read_tables(paths).to_pandas(types_mapper=_nullable)


def merge_rows(paths: Iterable[Path], merged: Path) -> None:
    """Write the rows of `paths`, in their order, to one file, which appears whole or not at all."""
    with replaced(merged) as partial:
        pq.write_table(_read_tables(paths), partial)


def _read_tables(paths: Iterable[Path]) -> pa.Table:
    tables = [SCHEMA.empty_table()]
    for path in paths:
        tables.append(pq.read_table(path))
        if not tables[-1].schema.equals(SCHEMA):
            raise InputError(f"'{path}' is not a table of study rows of this version.")
    return pa.concat_tables(tables)


def _nullable(kind: pa.DataType):
    return {pa.int64(): pd.Int64Dtype(), pa.bool_(): pd.BooleanDtype(), pa.string(): pd.StringDtype()}.get(kind)
