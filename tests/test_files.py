"""Every kind of file that the package reads, found in its modules: whatever is in one, a value or one sentence."""

import ast
import importlib
import json
import pkgutil
import re
import shutil
import time
from collections.abc import Iterator
from dataclasses import fields
from datetime import date
from pathlib import Path
from types import NoneType
from typing import TypedDict, get_args

import hostile
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

import lerobot_constructskill
from lerobot_constructskill import files
from lerobot_constructskill.analysis.report.page import write_report
from lerobot_constructskill.artifacts.tables import Parquet
from lerobot_constructskill.board.from_recordings import recorded_by_study
from lerobot_constructskill.board.protocol import BoardSetting
from lerobot_constructskill.comparison.sides import read_study
from lerobot_constructskill.errors import InputError, MissingError, UserError
from lerobot_constructskill.files import Json, Yaml, bounded_memory, parse_yaml, read_bytes, read_parquet, read_text
from lerobot_constructskill.policy_types import read_policy
from lerobot_constructskill.study.rows import read_rows

RESULTS = Path(__file__).parents[1] / "results"
PACKAGE = Path(lerobot_constructskill.__file__).parent
MODULES = [found.name for found in pkgutil.walk_packages([str(PACKAGE)], f"{lerobot_constructskill.__name__}.")]
OWN = {"sim/robot.py", "sim/visuals.py", "presets.py", "dataset/card.py", "artifacts/processor.py"}
"""Files that read what is installed or of the system alone."""


def policy_agent(checkpoint: Path) -> object:
    from lerobot_constructskill.rollout.agents import PolicyAgent

    return PolicyAgent.from_pretrained(checkpoint, "cpu")


def kinds() -> Iterator[tuple[str, Json | Parquet]]:
    """Every `Json`, `Yaml` and `Parquet` of the package, by the name of the module that makes it."""
    for module in MODULES:
        for name, value in vars(importlib.import_module(module)).items():
            several = value.values() if isinstance(value, dict) else [value]
            yield from ((f"{module}.{name}", one) for one in several if isinstance(one, Json | Parquet))


KINDS = dict({id(one): (name, one) for name, one in kinds()}.values())
READERS = {
    **{f"bytes: {what}": reader for what, reader in (("bytes", read_bytes), ("text", read_text))},
    **{name: one.read for name, one in KINDS.items()},
    "any table": read_parquet,
}


@pytest.mark.parametrize("reader", READERS.values(), ids=READERS)
def test_whatever_a_file_is_a_value_or_one_sentence_that_names_it(reader, tmp_path):
    path, before = tmp_path / "one", time.monotonic()
    for way, make in hostile.WAYS.items():
        make(path)
        try:
            with bounded_memory(300 << 20):
                reader(path)
        except UserError as error:
            assert str(path) in str(error) and "\n" not in str(error) and len(str(error)) < 600, way
        path.rmdir() if way == "a folder" else path.unlink()
    assert time.monotonic() - before < 60


DOORS = {
    "a report": write_report,
    "a comparison": lambda root: read_study(root, "brick_to_bin_shifted/heat_maps"),
    "a submission": lambda root: recorded_by_study(root, root, "heat_maps", {"one": BoardSetting("brick_to_bin")}),
}


@pytest.mark.parametrize("file", ["study.yaml", "rows.parquet"])
@pytest.mark.parametrize("door", DOORS.values(), ids=DOORS)
def test_a_study_with_a_damaged_file_is_refused_at_every_door(door, file, tmp_path):
    root = tmp_path / "study"
    root.mkdir()
    for name in ("study.yaml", "rows.parquet"):
        shutil.copy(RESULTS / "base_camera" / name, root)
    whole = (root / file).read_bytes()
    read_rows(root / "rows.parquet")  # Arrow starts its threads, whose stacks are no file's doing
    for way, damage in (hostile.WAYS | {"truncated": hostile.truncate}).items():
        damage(root / file)
        with pytest.raises(UserError) as refused, bounded_memory(300 << 20):
            door(root)
        assert file in str(refused.value) and "\n" not in str(refused.value), way
        (root / file).rmdir() if way == "a folder" else (root / file).unlink()
        (root / file).write_bytes(whole)
    assert not list(root.glob("report*"))


@pytest.mark.parametrize("reader", [read_policy, policy_agent], ids=["its type", "itself"])
def test_a_checkpoint_with_a_damaged_configuration_is_refused(reader, tmp_path):
    for damage in hostile.WAYS.values():
        damage(tmp_path / "config.json")
        with pytest.raises((UserError, OSError)) as refused:
            reader(tmp_path)
        assert "\n" not in str(refused.value) and len(str(refused.value)) < 1000
        path = tmp_path / "config.json"
        path.rmdir() if path.is_dir() else path.unlink()


def test_there_are_kinds_to_try():
    assert len(KINDS) > 15 and {type(one) for one in KINDS.values()} == {Json, Yaml, Parquet}


READING = re.compile(r"(json|tomllib)\.loads?\(|yaml\.\w*load\(|pq\.(read|ParquetFile)|pd\.read_|.*\.read_text\(")

PASSED = (
    "json.loads(json.dumps(",  # what was not in a file
    "json.loads(errors)",  # of columns that `Parquet.json` has checked
    "json.loads(text",
    "json.loads(row.versions)",
    "json.loads(_only({claim.versions",
    "tomllib.loads(read_text(",
    "files(__package__)",
    "log.read_text(",  # what LeRobot said to this process
)


@pytest.mark.parametrize("path", sorted(PACKAGE.rglob("*.py")), ids=lambda path: path.stem)
def test_nobody_reads_a_file_without_a_reader(path):
    if path.name != "files.py" and path.relative_to(PACKAGE).as_posix() not in OWN:
        calls = [ast.unparse(node) for node in ast.walk(ast.parse(path.read_text())) if isinstance(node, ast.Call)]
        assert not [call for call in calls if READING.match(call) and not call.startswith(PASSED)]


@pytest.mark.parametrize("path", sorted(PACKAGE.rglob("*.py")), ids=lambda path: path.stem)
def test_every_kind_is_found(path):
    """One that a function makes would be tried by nobody."""
    functions = [node for node in ast.walk(ast.parse(path.read_text())) if isinstance(node, ast.FunctionDef)]
    calls = [one for function in functions for one in ast.walk(function) if isinstance(one, ast.Call)]
    assert not [ast.unparse(one) for one in calls if ast.unparse(one.func) in ("Json", "Yaml", "Parquet")]


TEXTS = {"open", "read_text", "write_text", "fdopen", "NamedTemporaryFile"}


@pytest.mark.parametrize("path", sorted(PACKAGE.rglob("*.py")), ids=lambda path: path.stem)
def test_no_text_is_in_the_encoding_of_somebodys_locale(path):
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Call):
            name = getattr(node.func, "attr", getattr(node.func, "id", ""))
            said = ast.unparse(node)
            other = said.startswith(("os.", "Image.", "av.", "read_text", "write_text")) or "'rb'" in said
            if name in TEXTS and not other:
                assert "encoding" in said or "**text" in said or "'wb'" in said, f"{path.name}: {said}"


class Verdict(TypedDict):
    level: int
    names: list[str]


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ('{"level": 1}', "names: it is missing"),
        ('{"level": true, "names": []}', "level: Input should be a valid integer"),
        ('{"level": 1, "names": [null]}', "names.0: Input should be a valid string"),
        ('{"level": 1, "level": 2, "names": []}', "'level' stands there twice"),
        ('{"level": 99999999999999999999, "names": []}', "more than 64 bits"),
        ('{"level": 1, "names": ["\\ud800"]}', "half of a character"),
        ("[" * 5000, "nested too deeply"),
        ("[]", "should be an object"),
    ],
)
def test_a_value_of_another_kind_is_said_to_be_one(text, said):
    with pytest.raises(InputError, match=f"^'x' is not a verdict: .*{said}"):
        Json("a verdict", Verdict).parse(text, "'x'")


def test_nothing_is_converted_and_nothing_dropped():
    assert Json("a verdict", Verdict).parse('{"level": 1, "names": [], "more": [1.5]}', "'x'")["more"] == [1.5]


@pytest.mark.parametrize(
    ("text", "value"),
    [
        ("010", "010"),
        ("1:30", "1:30"),
        ("2026-11-28", "2026-11-28"),
        ("no", "no"),
        ("on", "on"),
        ("true", True),
        ("-12", -12),
        ("0x1f", 31),
        ("1.5e+3", 1500.0),
        ("1e-4", "1e-4"),
        (".inf", float("inf")),
        ("'010'", "010"),
        ("~", None),
    ],
)
def test_yaml_is_what_it_looks_like(text, value):
    assert parse_yaml(text) == value and type(parse_yaml(text)) is type(value)
    assert not isinstance(value, date)


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("a: !!int '010'", "the tag tag:yaml.org,2002:int is not read"),
        ("a: !!bool yes", "is not read"),
        ("a: &x {b: 1}\nc:\n  <<: *x\n  <<: *x", "line 4: '<<' stands there a second time"),
        ("{1: a, '1': b}", "'1' stands there a second time"),
        (r'a: "\ud800"', "half of a character"),
        ("a: 1\n---\nb: 2", "expected a single document|but found another document"),
    ],
)
def test_yaml_does_not_say_two_things(text, said):
    with pytest.raises(InputError, match=said):
        parse_yaml(text)


@pytest.mark.parametrize(
    "table", [one for one in KINDS.values() if isinstance(one, Parquet)], ids=lambda one: one.what
)
def test_a_table_lacks_no_value_that_it_must_have(table, tmp_path):
    """Each column in turn, and no rows at all."""
    columns = {one.name: pa.nulls(1, one.type) for one in table.schema}
    for one in fields(table.kind):
        if NoneType not in get_args(one.type):
            kind = table.schema.field(one.name).type
            value = {"string": "{}", "int64": 1, "bool": True}.get(str(kind), [])
            columns[one.name] = pa.array([value], kind)
    whole = pa.table(columns, schema=table.schema)
    path = tmp_path / "table.parquet"
    pq.write_table(whole, path)
    assert table.read(path).num_rows == 1
    for number, one in enumerate(fields(table.kind)):
        if NoneType not in get_args(one.type):
            pq.write_table(
                whole.set_column(number, table.schema[number], pa.nulls(1, table.schema[number].type)), path
            )
            with pytest.raises(InputError, match=f"{one.name} is missing in a row"):
                table.read(path)
    pq.write_table(whole.slice(0, 0), path)
    with pytest.raises(InputError, match="it has no rows"):
        table.read(path)


def test_a_column_of_json_holds_json(tmp_path):
    from lerobot_constructskill.study.rows import EpisodeRow, read_rows, write_rows

    row = {"run": None, "training_seed": 0, "evaluation_seed": 0, "episode": 0}
    for text in ("{junk", "[]", '{"torch": 1}', "[" * 5000, '{"torch": "\\ud800"}'):
        write_rows([EpisodeRow(**row, versions=text)], tmp_path / "rows.parquet", EpisodeRow)
        with pytest.raises(InputError, match=r"^versions in '.*rows\.parquet' is not versions, package to version: "):
            read_rows(tmp_path / "rows.parquet", EpisodeRow)


def test_a_table_that_unpacks_to_gigabytes_is_not_unpacked(tmp_path):
    zeros = pa.table({"zeros": pa.nulls(1, pa.binary()).fill_null(bytes(1 << 20)).take(pa.array([0] * 400))})
    pq.write_table(zeros, tmp_path / "bomb.parquet", compression="zstd", use_dictionary=False)
    assert (tmp_path / "bomb.parquet").stat().st_size < 1 << 20
    with pytest.raises(InputError, match="unpacks to more than"), bounded_memory(200 << 20):
        read_parquet(tmp_path / "bomb.parquet", most=files.MOST)


def test_what_is_not_there_is_missing(tmp_path):
    for read in (read_bytes, read_text, read_parquet, Json("a thing").read):
        with pytest.raises(MissingError, match="There is no file"):
            read(tmp_path / "nothing")
    (tmp_path / "file").write_text(json.dumps({"a": 1}))
    with pytest.raises(MissingError):
        read_text(tmp_path / "file" / "below")


def test_windows_mark_is_no_part_of_a_text(tmp_path):
    (tmp_path / "one").write_text('{"a": 1}', encoding="utf-8-sig")
    assert Json("a thing").read(tmp_path / "one") == {"a": 1}
