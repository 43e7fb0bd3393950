"""Tables of an earlier version, read with the columns of this one."""

from collections.abc import Collection

import pyarrow as pa


def with_later_columns(table: pa.Table, schema: pa.Schema, later: Collection[str]) -> pa.Table:
    """`table` with null in those columns of `schema` that it lacks and that `later` versions brought."""
    for index, field in enumerate(schema):
        if field.name in later and field.name not in table.column_names:
            table = table.add_column(min(index, table.num_columns), field, pa.nulls(len(table), field.type))
    return table
