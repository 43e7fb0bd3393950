"""Makes configurations of flags, files and plain values by draccus; each refusal is one sentence for the user."""

import argparse
import os
import re
import shlex
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import fields, is_dataclass
from enum import Enum
from pathlib import Path
from types import NoneType
from typing import Annotated, Any, get_args, get_origin, get_type_hints

import draccus
import mergedeep
import yaml

from lerobot_constructskill.bounds import UNIONS, allows, refusal
from lerobot_constructskill.errors import FieldError, InputError, UserError
from lerobot_constructskill.files import Json, Loader, Yaml, parse_yaml
from lerobot_constructskill.lerobot_internals import ArgumentParser
from lerobot_constructskill.presets import find

TEXTS = {str, Path, NoneType}
"""Types of fields whose flags are taken as text, as they were written."""


def parse[Config](
    config_class: type[Config],
    flags: Sequence[str],
    config_path: Path | str | None = None,
) -> Config:
    """Read a configuration from flags, and from a YAML file that they are put over.

    Raises:
        InputError: they do not make a configuration.
        MissingError: there is no such file, or a `!policy` in it names no shipped policy.
    """
    with as_input():
        return Parser(config_class, config_path, exit_on_error=False).parse_args(flags)


def parse_named[Config](config_class: type[Config], kind: str, text: str, flags: Sequence[str] = ()) -> Config:
    """Read what a command line would say of a shipped configuration or a file: `fast --episodes=32`.

    Args:
        kind: one of `presets.KINDS`.
        text: the name or the file, and the flags that are put over it, in quotation marks where they hold spaces.
        flags: others, which go before.

    Raises:
        MissingError: there is neither such a name nor such a file.
        InputError: they do not make a configuration.
    """
    with as_input():
        name, *own = shlex.split(text) or [""]
    return parse(config_class, [*flags, *own], find(kind, name))


class Parser(ArgumentParser):
    """draccus' parser of flags, which reads their values and the file by our own loaders."""

    def _postprocessing(self, flags: argparse.Namespace) -> Any:
        texts = {"config_path": self.config_path} | vars(flags)
        path = texts.pop("config_path")
        said = {name: _value(text, kind_of(self.config_class, name)) for name, text in texts.items()}
        read = {} if path is None else read_fields(Path(path))
        return decode(
            self.config_class, mergedeep.merge(read, draccus.utils.deflatten(said, sep=".")), is_command=True
        )


def kind_of(config_class: type, name: str) -> Any:
    """The annotation of a field that a flag names, `noise.sigma` for instance."""
    kind: Any = config_class
    for part in name.split("."):
        kind = next(
            (
                get_type_hints(one, include_extras=True).get(part, Any)
                for one in _alternatives(kind)
                if is_dataclass(one)
            ),
            Any,
        )
    return kind


def _value(text: str, kind: Any) -> Any:
    """The value of a flag: its text, where the field is text or where the text is no YAML, or what it is in YAML.

    `~/` is the home folder; a shell does not replace it behind an equals sign.
    """
    text = os.path.expanduser(text) if text.startswith("~/") else text
    if not text or {*_alternatives(kind)} <= {str, Path} or (text != "null" and {*_alternatives(kind)} <= TEXTS):
        return text
    try:
        return parse_yaml(text)
    except InputError:
        return text


class ConfigurationLoader(Loader):
    """YAML of our configuration files, in which `!policy` stands for the fields of a shipped policy.

    `!policy precise` stands for the fields of `configs/policy/precise.yaml`; `!policy {preset: precise, camera: base}`
    for the same fields with another value. The tag opens no other file, and other loaders refuse it.
    """

    own_tags = frozenset({"!policy"})


def _policy(loader: ConfigurationLoader, node: yaml.Node) -> dict[str, Any]:
    if isinstance(node, yaml.ScalarNode):
        name, fields = node.value, {}
    else:
        fields = loader.construct_mapping(node, deep=True)
        if "preset" not in fields:
            raise InputError("`!policy {…}` must name the policy that it starts from, such as `preset: precise`.")
        name = fields.pop("preset")
    return read_fields(find("policy", str(name), or_file=False)) | fields


ConfigurationLoader.add_constructor("!policy", _policy)

YAML = Yaml("a configuration, a mapping of fields", loader=ConfigurationLoader)
JSON = Json("a configuration, a mapping of fields")


def read_fields(path: Path) -> dict[str, Any]:
    """The fields of a configuration file as plain values.

    Raises:
        MissingError: there is no such file, or a `!policy` in it names no shipped policy.
        InputError: it is not what `files.Loader` reads, no mapping, or a `!policy` in it names no policy.
    """
    return (JSON if path.suffix == ".json" else YAML).read(path)


def decode[Config](config_class: type[Config], values: Mapping[str, Any], is_command: bool = False) -> Config:
    """Make a configuration of plain values.

    Args:
        is_command: whether its fields are flags of a command, with a `--help`.

    Raises:
        InputError: they do not make one, or draccus would turn one of them into something else.
    """
    with as_input():
        try:
            made = draccus.decode(config_class, values)
        except draccus.utils.DecodingError as error:
            if said := _of_fields(error, config_class, is_command):
                raise InputError(said) from None
            name, found = ".".join(error.key_path), values
            for part in error.key_path:
                found = found.get(part) if isinstance(found, Mapping) else None
            if allows(kind := kind_of(config_class, name), found):
                raise
            raise InputError(refusal(name, kind, found)) from None
        check_same(made, values)
        return made


def _of_fields(error: draccus.utils.DecodingError, config_class: type, is_command: bool) -> str | None:
    """What is wrong with the names of fields, if that is it: draccus says it in the code's words."""
    where, names = ".".join(error.key_path), re.findall(r"`([^`]*)`", error.message)
    if error.message.startswith("Missing required field"):
        are_flags = is_command and not where
        before = "--" if are_flags else f"{where}." if where else ""
        it, are = ("it", "is") if len(names) == 1 else ("they", "are")
        hint = f"; `--help` says what {it} {are}" if are_flags else ""
        return f"{' and '.join(f'`{before}{name}`' for name in names)} {are} missing{hint}."
    if "are not valid for" in error.message:
        kind = kind_of(config_class, where) if where else config_class
        owners = [one for one in _alternatives(kind) if isinstance(one, type) and is_dataclass(one)]
        there = [one.name for owner in owners if error.message.endswith(f" {owner.__name__}") for one in fields(owner)]
        known = f"; it has {', '.join(there)}" if there else ""
        return f"{where or 'The configuration'} has no field {' and no field '.join(map(repr, names))}{known}."
    return None


def check_same(made: Any, given: Any, name: str = "", kind: Any = Any) -> None:
    """Refuse plain values that draccus has turned into others: true into 1, 1.10 into "1.1", [] into all defaults.

    A value of the default's type is right whatever the annotation says: LeRobot annotates some truth values as int.

    Args:
        made: what draccus made.
        given: what it was made of.
        name: of the field.
        kind: the field's annotation.

    Raises:
        InputError: the message names the field.
    """
    if is_dataclass(made) and isinstance(given, Mapping):
        hints = get_type_hints(type(made), include_extras=True)
        for one in fields(made):
            if one.name in given and type(given[one.name]) is not type(one.default):
                check_same(getattr(made, one.name), given[one.name], f"{name}.{one.name}".lstrip("."), hints[one.name])
    elif isinstance(made, Mapping) and isinstance(given, Mapping):
        for key in made.keys() & given.keys():
            check_same(made[key], given[key], f"{name}.{key}")
    elif isinstance(made, list | tuple) and isinstance(given, list | tuple):
        for one, item in zip(made, given, strict=False):
            check_same(one, item, name, kind)
    elif made is not None and given is not None and not _is_same(made, given):
        hint = " Put it in quotation marks." if isinstance(made, str | Path) and isinstance(given, int | float) else ""
        raise InputError(refusal(name, kind, given) + hint)


def _is_same(made: Any, given: Any) -> bool:
    if isinstance(made, Path | Enum):
        return isinstance(given, str)
    return type(given) in ((int, float, str) if isinstance(made, float) else (type(made),))


def _alternatives(kind: Any) -> Iterable[Any]:
    if get_origin(kind) is Annotated:
        return _alternatives(get_args(kind)[0])
    if get_origin(kind) in UNIONS:
        return (one for each in get_args(kind) for one in _alternatives(each))
    return (kind,)


@contextmanager
def as_input() -> Iterator[None]:
    """Turn the errors of draccus, argparse and YAML into an `InputError`; our own errors and `OSError` pass."""
    try:
        yield
    except (OSError, InputError):
        raise
    except (TypeError, AttributeError):  # draccus merges fields, and copies them, before it looks at them
        raise InputError("The configuration's file is empty or is not a mapping of fields.") from None
    except Exception as error:  # these have no base class in common
        root = error
        while root.__cause__ is not None:
            root = root.__cause__
        if isinstance(root, FieldError) or not isinstance(root, UserError | OSError):
            said = error if isinstance(error, draccus.utils.DecodingError) else root
            raise InputError(str(said)) from error
        raise root from None
