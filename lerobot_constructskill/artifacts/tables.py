"""Reads Parquet files whose columns are the fields of a dataclass."""

from collections.abc import Mapping
from dataclasses import dataclass, field, fields
from functools import cached_property
from pathlib import Path
from types import NoneType
from typing import Any, get_args

import pyarrow as pa

from lerobot_constructskill.errors import InputError
from lerobot_constructskill.files import Json, read_parquet

MOST = 256 << 20
"""Bytes that a table may have, unpacked."""

VERSIONS = Json("versions, package to version", dict[str, str])

_ARROW = {str: pa.string(), int: pa.int64(), float: pa.float64(), bool: pa.bool_()}


@dataclass(frozen=True)
class Parquet:
    """Parquet files whose columns are the fields of a dataclass; a field that may be None may be null.

    Args:
        what: what such a file is called, with its article.
        kind: the dataclass.
        types: Arrow's type of each annotation that is no str, int, float or bool.
        json: columns that hold JSON.
        added: fields that may be None and that older files lack.
    """

    what: str
    kind: type
    types: Mapping[Any, pa.DataType] = field(default_factory=dict)
    json: Mapping[str, Json] = field(default_factory=dict)
    added: tuple[str, ...] = ()

    @cached_property
    def schema(self) -> pa.Schema:
        return pa.schema([(one.name, self._type(one.type)) for one in fields(self.kind)])

    def _type(self, annotation: Any) -> pa.DataType:
        kinds = _ARROW | dict(self.types)
        return next(kinds[kind] for kind in (annotation, *get_args(annotation)) if kind in kinds)

    def read(self, path: Path) -> pa.Table:
        """The rows of a file, at least one.

        Raises:
            MissingError: there is no such file.
            InputError: it is of another kind, or a value is missing.
        """
        table = self._completed(read_parquet(path, most=MOST))
        if not table.schema.equals(self.schema):
            raise InputError(f"'{path}' is not {self.what} of this version.")
        if not len(table):
            raise InputError(f"'{path}' is not {self.what}: it has no rows.")
        for one in fields(self.kind):
            if table[one.name].null_count and NoneType not in get_args(one.type):
                raise InputError(f"'{path}' is not {self.what}: {one.name} is missing in a row.")
        for name, kind in self.json.items():
            for text in table[name].unique().drop_null().to_pylist():
                kind.parse(text, f"{name} in '{path}'")
        return table

    def _completed(self, table: pa.Table) -> pa.Table:
        """A table that may be older than some columns, with these."""
        if not (missing := [name for name in self.added if name not in table.column_names]):
            return table
        for name in missing:
            table = table.append_column(self.schema.field(name), pa.nulls(len(table), self.schema.field(name).type))
        names = [name for name in self.schema.names if name in table.column_names]
        return table.select([*names, *(name for name in table.column_names if name not in self.schema.names)])
