"""How a stranger's file is opened: as data, with bounds. Nothing in it is executed, no size in it is believed."""

import os
import resource
import stat
import sys
from collections import Counter
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import MISSING, fields
from pathlib import Path
from typing import Any

import yaml

from lerobot_constructskill.errors import InputError, MissingError, first_line

PAGE = 4096


def read_files(root: Path, most: Mapping[str, int]) -> dict[str, bytes]:
    """The bytes of a folder's files, which are to be exactly those of `most`, each of at most so many bytes.

    Raises:
        MissingError: there is no such folder, or one of the files is not in it.
        InputError: something else is in it, a link or a device for instance, or a file is too large.
    """
    if root.is_symlink() or not root.is_dir():
        raise MissingError(f"'{root}' is not the folder of a submission.")
    found = {entry.name: entry for entry in os.scandir(root)}
    if absent := [name for name in most if name not in found]:
        raise MissingError(f"'{root}' is not a submission: {absent[0]} is missing.")
    if others := sorted(set(found) - set(most)):
        raise InputError(f"'{root}' holds {others[0]!a}; a submission is {' and '.join(most)}, and nothing else.")
    return {name: _read(root / name, size) for name, size in most.items()}


def _read(path: Path, most: int) -> bytes:
    try:
        descriptor = os.open(path, os.O_RDONLY | os.O_NOFOLLOW | os.O_NONBLOCK)
    except OSError as error:
        raise InputError(f"'{path}' is not a regular file ({error.strerror}).") from None
    with open(descriptor, "rb") as file:
        if not stat.S_ISREG(os.fstat(descriptor).st_mode):
            raise InputError(f"'{path}' is not a regular file.")
        content = file.read(most + 1)
    if len(content) > most:
        raise InputError(f"'{path}' has more than {most:,} bytes.")
    return content


class _Plain(yaml.SafeLoader):
    """YAML as a list of settings needs it: no tags, no anchors, no key twice, no number that cannot be printed."""

    def compose_node(self, parent, index):
        event = self.peek_event()
        if isinstance(event, yaml.AliasEvent) or event.anchor is not None or getattr(event, "tag", None) is not None:
            raise InputError("tags, anchors and aliases are not read")
        return super().compose_node(parent, index)

    def construct_mapping(self, node, deep=False):
        keys = Counter(self.construct_object(key) for key, _ in node.value)
        if twice := [key for key, count in keys.items() if count > 1]:
            raise InputError(f"{twice[0]!a} appears twice")
        return super().construct_mapping(node, deep)

    def construct_object(self, node, deep=False):
        value = super().construct_object(node, deep)
        if isinstance(value, int) and value.bit_length() > 64:
            raise InputError("a number in it has more than 64 bits")
        return value


def read_yaml(content: bytes, name: str) -> Any:
    """What a YAML file says, in plain values.

    Raises:
        InputError: it is no YAML, or more than plain YAML.
    """
    try:
        return yaml.load(content.decode(), _Plain)
    except RecursionError:
        raise InputError(f"{name} cannot be read: it is nested too deeply.") from None
    # A key that cannot be one is a TypeError, a number in too many parts an OverflowError.
    except (InputError, ValueError, TypeError, OverflowError, yaml.YAMLError) as error:
        raise InputError(f"{name} cannot be read: {first_line(error)}.") from None


def make[Kind](kind: type[Kind], values: Any, where: str) -> Kind:
    """A dataclass, which checks its own values, of a mapping that has its fields and no other.

    Raises:
        InputError: the mapping has not, or a value is refused.
    """
    if not isinstance(values, dict):
        raise InputError(f"{where} must be a mapping of names to values.")
    names = {field.name: field for field in fields(kind)}
    if unknown := [key for key in values if key not in names]:
        raise InputError(f"{where} has no field {unknown[0]!a}; it has: {', '.join(names)}.")
    for name, field in names.items():
        if name not in values and field.default is MISSING and field.default_factory is MISSING:
            raise InputError(f"{where} lacks the field '{name}'.")
    try:
        return kind(**values)
    except InputError as error:
        raise InputError(f"{where}: {error}") from None


@contextmanager
def bounded_memory(more: int) -> Iterator[None]:
    """Let this process take at most `more` bytes than it has: a page that unpacks to gigabytes is a `MemoryError`."""
    if sys.platform != "linux":
        yield
        return
    soft, hard = resource.getrlimit(resource.RLIMIT_AS)
    now = int(Path("/proc/self/statm").read_text().split()[0]) * PAGE
    wanted = now + more if hard == resource.RLIM_INFINITY else min(now + more, hard)
    resource.setrlimit(resource.RLIMIT_AS, (wanted, hard))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_AS, (soft, hard))
