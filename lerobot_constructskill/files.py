"""How a file is read that another may have written, or a full disk has torn: as data, with bounds.

    VERDICT = Json("a verdict of constructskill-verify", Verdict)
    verdict = VERDICT.read(path)

Nothing in a file is executed, no size in it is believed, and whatever is wrong with it is one sentence that names it.
"""

import json
import os
import re
import resource
import stat
import sys
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from copy import deepcopy
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar, is_typeddict

import yaml

from lerobot_constructskill.errors import InputError, MissingError, first_line

if TYPE_CHECKING:
    import pyarrow as pa

MOST, MOST_YAML = 8 << 20, 1 << 18
"""Bytes that a file of JSON may have, and one of YAML, which takes a hundred times as long to read."""

MOST_VALUES = 300_000
"""Values that a file may hold, with what aliases of YAML repeat: a few hundred bytes can repeat billions."""

MOST_BITS = 64
"""Bits that a whole number may have."""

MERGE = "tag:yaml.org,2002:merge"
PAGE = 4096


def read_bytes(path: Path, most: int = MOST, links: bool = True) -> bytes:
    """The content of a regular file.

    Args:
        most: bytes that it may have.
        links: whether the path may be a symbolic link to it.

    Raises:
        MissingError: there is none.
        InputError: it is a pipe, a device, a folder or another thing that is no file, or it is larger.
    """
    try:
        descriptor = os.open(path, os.O_RDONLY | os.O_NONBLOCK | (0 if links else os.O_NOFOLLOW))
    except (FileNotFoundError, NotADirectoryError):
        raise MissingError(f"There is no file '{path}'.") from None
    except OSError as error:
        raise InputError(f"'{path}' cannot be opened ({error.strerror}).") from None
    try:
        if not stat.S_ISREG(os.fstat(descriptor).st_mode):
            raise InputError(f"'{path}' is not a regular file.")
        with open(descriptor, "rb", closefd=False) as file:
            content = file.read(most + 1)
    finally:
        os.close(descriptor)
    if len(content) > most:
        raise InputError(f"'{path}' has more than {most:,} bytes.")
    return content


def read_text(path: Path, most: int = MOST) -> str:
    """The content of a regular file as text. Raises as `read_bytes` does, and InputError where it is not UTF-8."""
    return to_text(read_bytes(path, most), f"'{path}'")


def to_text(content: bytes, where: str) -> str:
    """The text of a file, without the mark that Windows' editors begin with. Raises InputError: it is not UTF-8."""
    try:
        return content.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise InputError(f"{where} is not text in UTF-8 (byte {error.start + 1}).") from None


@dataclass(frozen=True)
class Json[Kind]:
    """Files of JSON of one kind.

    Args:
        what: what such a file is called, with its article.
        kind: the type of the value; nothing is converted. A field that a `TypedDict` does not name is kept, one that a
            dataclass does not name is refused.
    """

    what: str
    kind: type[Kind] = dict[str, Any]
    most: ClassVar[int] = MOST

    def read(self, path: Path) -> Kind:
        """Raises as `read_text` does, and InputError where the file is of another kind."""
        return self.parse(read_text(path, self.most), f"'{path}'")

    def parse(self, text: str, where: str) -> Kind:
        """The value of a text that stands at `where`, the subject of whatever is said of it."""
        return _plain(lambda: self._checked(self._load(text)), f"{where} is not {self.what}")

    def _load(self, text: str) -> Any:
        return _json(text)

    def _checked(self, value: Any) -> Kind:
        from pydantic import ValidationError

        extra = "allow" if is_typeddict(self.kind) else "forbid"
        try:  # in its own JSON, where a mapping may be a dataclass
            made = self._adapter.validate_json(json.dumps(value), strict=True, extra=extra)
            return value if is_typeddict(self.kind) else made  # pydantic would put the named ones first
        except ValidationError as error:
            first = error.errors(include_url=False, include_input=False)[0]
        reasons = {
            "missing": "it is missing",
            "unexpected_keyword_argument": "there is no such field",
            "value_error": str(first.get("ctx", {}).get("error")),  # of a dataclass that checks its values
        }
        said = reasons.get(first["type"], first["msg"])
        raise InputError(": ".join(filter(None, (".".join(map(str, first["loc"])), said))))

    @cached_property
    def _adapter(self):
        from pydantic import TypeAdapter

        return TypeAdapter(self.kind)


def _json(text: str) -> Any:
    if sum(map(text.count, ",[{")) > MOST_VALUES:
        raise InputError(f"it holds more than {MOST_VALUES:,} values")

    def mapping(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
        made = dict(pairs)
        if len(made) < len(pairs):
            twice, _ = Counter(name for name, _ in pairs).most_common(1)[0]
            raise InputError(f"{twice!a} stands there twice")
        return made

    value = json.loads(text, object_pairs_hook=mapping, parse_int=lambda digits: _bounded(int(digits[:MOST_BITS])))
    return _whole(value) if "\\u" in text else value


def _bounded(number: int) -> int:
    if number.bit_length() > MOST_BITS:
        raise InputError(f"a number in it has more than {MOST_BITS} bits")
    return number


class Loader(yaml.SafeLoader):
    """Loads YAML of settings. A key that stands twice is refused; PyYAML would keep the last value.

    As in YAML 1.2, these are text: 010 (eight in YAML 1.1), 1:30 (ninety), dates, and yes, no, on and off.
    """

    own_tags: frozenset[str] = frozenset()
    """Tags that are read. YAML's own are refused, because `!!int '010'` contradicts its text."""

    yaml_implicit_resolvers = deepcopy(yaml.SafeLoader.yaml_implicit_resolvers)

    def get_single_node(self) -> yaml.Node | None:
        node = super().get_single_node()
        if node is not None and _count(node, {}) > MOST_VALUES:
            raise InputError(f"it stands for more than {MOST_VALUES:,} values: its aliases multiply")
        return node

    def compose_node(self, parent: yaml.Node | None, index: Any) -> yaml.Node:
        tag = getattr(self.peek_event(), "tag", None)
        if tag is not None and tag not in self.own_tags:
            raise InputError(f"the tag {tag} is not read")
        return super().compose_node(parent, index)

    def compose_mapping_node(self, anchor: str | None) -> yaml.MappingNode:
        node, known = super().compose_mapping_node(anchor), set()
        for key in (key for key, _ in node.value if isinstance(key, yaml.ScalarNode)):
            value = key.value if key.tag == MERGE else str(self.construct_object(key))
            if value in known:
                raise InputError(f"line {key.start_mark.line + 1}: {value!a} stands there a second time, keep one")
            known.add(value)
        return node

    def construct_yaml_int(self, node: yaml.ScalarNode) -> int:
        return _bounded(super().construct_yaml_int(node))


Loader.add_constructor("tag:yaml.org,2002:int", Loader.construct_yaml_int)
KEPT = {
    "tag:yaml.org,2002:bool": "true|True|TRUE|false|False|FALSE",
    "tag:yaml.org,2002:int": "[-+]?(?:0|[1-9][0-9_]*)|0x[0-9a-fA-F_]+",
    "tag:yaml.org,2002:float": r"[-+]?(?:[0-9][0-9_]*\.[0-9_]*|\.[0-9]+)(?:[eE][-+]?[0-9]+)?|[-+]?\.inf|\.nan",
    "tag:yaml.org,2002:timestamp": "(?!)",
}
"""The plain texts that are read as a truth value, a number or a date."""

for resolvers in Loader.yaml_implicit_resolvers.values():
    resolvers[:] = [(tag, re.compile(f"(?:{KEPT[tag]})\\Z") if tag in KEPT else rule) for tag, rule in resolvers]


def _count(node: yaml.Node, counted: dict[int, int]) -> int:
    """The number of values that a node stands for. A node that holds itself, which YAML allows, has too many."""
    if id(node) not in counted:
        counted[id(node)] = MOST_VALUES + 1
        parts = node.value if isinstance(node, yaml.CollectionNode) else ()
        parts = [one for part in parts for one in (part if isinstance(part, tuple) else (part,))]
        counted[id(node)] = 1 + sum(_count(part, counted) for part in parts)
    return counted[id(node)]


@dataclass(frozen=True)
class Yaml[Kind](Json[Kind]):
    """Files of YAML of one kind.

    Args:
        loader: the class that decides which tags are read.
    """

    loader: type[Loader] = Loader
    most: ClassVar[int] = MOST_YAML

    def _load(self, text: str) -> Any:
        return _yaml(text, self.loader)


def parse_yaml(text: str) -> Any:
    """The value of a text. Raises InputError where it is no YAML."""
    return _plain(lambda: _yaml(text, Loader), "It cannot be read")


def _yaml(text: str, loader: type[Loader]) -> Any:
    return _whole(yaml.load(text, loader))


def _whole(value: Any) -> Any:
    """Return a value whose text can be encoded. Raises UnicodeEncodeError: it holds half of a character."""
    json.dumps(value, ensure_ascii=False, default=str).encode()
    return value


def _plain[Value](parse: Callable[[], Value], failing: str) -> Value:
    """Return what `parse` returns, and turn its errors into one sentence that begins with `failing`."""
    try:
        return parse()
    except RecursionError:
        reason = "it is nested too deeply"
    except UnicodeEncodeError:
        reason = "it holds half of a character, which no file can hold"
    except yaml.MarkedYAMLError as error:
        reason = f"line {(error.problem_mark or error.context_mark).line + 1}: {error.problem}"
    except MissingError:  # of something that a tag names
        raise
    # A key that cannot be one is a TypeError, a number in too many parts an OverflowError.
    except (InputError, ValueError, TypeError, OverflowError, yaml.YAMLError) as error:
        reason = first_line(error)
    raise InputError(f"{failing}: {reason.rstrip('.')}.") from None


def read_parquet(path: Path, columns: Sequence[str] | None = None, most: int | None = None) -> "pa.Table":
    """The rows of any Parquet file.

    Args:
        columns: those that are read; all by default.
        most: bytes that they may have unpacked.

    Raises:
        MissingError: there is no such file.
        InputError: it cannot be read.
    """
    import pyarrow as pa
    import pyarrow.parquet as pq

    try:
        if not stat.S_ISREG(path.stat().st_mode):
            raise InputError(f"'{path}' is not a regular file.")
        with pq.ParquetFile(path) as file:
            groups = [file.metadata.row_group(number) for number in range(file.metadata.num_row_groups)]
            if most is not None and sum(group.total_byte_size for group in groups) > most:
                raise InputError(f"'{path}' unpacks to more than {most:,} bytes.")
            if absent := [name for name in columns or () if name not in file.schema_arrow.names]:
                raise InputError(f"'{path}' has no column {absent[0]}.")
            table = file.read(columns, use_threads=most is None)  # of a small table they only take memory
            table.validate(full=True)
    except FileNotFoundError:
        raise MissingError(f"There is no file '{path}'.") from None
    except InputError:
        raise
    except (pa.ArrowException, OSError, ValueError) as error:
        raise InputError(f"'{path}' cannot be read: {first_line(error)[:200].rstrip('.')!a}.") from None
    return table


@contextmanager
def bounded_memory(more: int) -> Iterator[None]:
    """Limit this process to `more` bytes beyond those that it has; more than that is a `MemoryError`."""
    if sys.platform != "linux":
        yield
        return
    soft, hard = resource.getrlimit(resource.RLIMIT_AS)
    now = int(Path("/proc/self/statm").read_text(encoding="ascii").split()[0]) * PAGE
    wanted = now + more if hard == resource.RLIM_INFINITY else min(now + more, hard)
    resource.setrlimit(resource.RLIMIT_AS, (wanted, hard))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_AS, (soft, hard))
