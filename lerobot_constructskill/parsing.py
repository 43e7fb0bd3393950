"""Configurations by draccus, from flags, files and plain values; what it cannot read is the user's to mend."""

import argparse
import os
import shlex
import traceback
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import MISSING, fields, is_dataclass
from pathlib import Path
from types import NoneType, UnionType
from typing import Any, Union, get_args, get_origin, get_type_hints

import draccus
import mergedeep

from lerobot_constructskill import tags
from lerobot_constructskill.bounds import LONGEST, NAMES
from lerobot_constructskill.errors import FieldError, InputError
from lerobot_constructskill.files import Json, parse_yaml
from lerobot_constructskill.lerobot_internals import ArgumentParser
from lerobot_constructskill.presets import find

OURS = Path(__file__).parent

CONFIGURATION = Json("a configuration")
"""One in JSON; one in YAML may have our tags."""


def parse[Config](
    config_class: type[Config],
    flags: Sequence[str],
    config_path: Path | str | None = None,
    epilog: str | None = None,
) -> Config:
    """Read a configuration from flags, and from a YAML file that they are put over.

    Raises:
        InputError: they do not make a configuration.
        MissingError: there is no such file, or a `!policy` in it names no shipped policy.
    """
    named, flags = _take_config_path(flags)
    with as_input():
        path = config_path if named is None else named
        return Parser(config_class, path, exit_on_error=False, epilog=epilog).parse_args(flags)


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
    if {"-h", "--help"} & {*own}:
        raise InputError(f"'{text}' asks for help, and is no configuration.")
    return parse(config_class, [*flags, *own], find(kind, name))


def _take_config_path(flags: Sequence[str]) -> tuple[str | None, list[str]]:
    """The value of `--config_path`, and the other flags."""
    parser = argparse.ArgumentParser(add_help=False, allow_abbrev=False, exit_on_error=False)
    parser.add_argument("--config_path")
    with as_input():
        taken, others = parser.parse_known_args(flags)
    return taken.config_path, others


class Parser(ArgumentParser):
    """draccus' parser of flags, but their values and the file are read as `files.Loader` reads."""

    def _postprocessing(self, flags: argparse.Namespace) -> Any:
        said = {name: _value(text, _kind_of(self.config_class, name)) for name, text in vars(flags).items()}
        read = {} if self.config_path is None else _read(Path(self.config_path))
        return decode(self.config_class, mergedeep.merge(read, draccus.utils.deflatten(said, sep=".")))


def _kind_of(config_class: type, name: str) -> Any:
    """The annotation of a field that a flag names, `noise.sigma` for instance."""
    kind: Any = config_class
    for part in name.split("."):
        kind = next((get_type_hints(one).get(part, Any) for one in _alternatives(kind) if is_dataclass(one)), Any)
    return kind


def _value(text: str, kind: Any) -> Any:
    """A flag's value is YAML, or text where it is none: `--only=*/seed_0` is no alias. Where text belongs, it is text.

    `~/` is the home folder; a shell does not replace it behind an equals sign.
    """
    text = os.path.expanduser(text) if text.startswith("~/") else text
    if not text or {*_alternatives(kind)} <= {str, Path} or (text != "null" and {*_alternatives(kind)} <= TEXTS):
        return text
    try:
        return parse_yaml(text, "It")
    except InputError:
        return text


def _read(path: Path) -> dict[str, Any]:
    read = CONFIGURATION.read(path) if path.suffix == ".json" else tags.read(path)
    if not isinstance(read, dict):
        raise InputError(f"'{path}' is empty or is not a mapping of fields.")
    return read


def tells_of_bases[Config](config_class: type[Config]) -> type[Config]:
    """Decorate a configuration so that its `--help` tells of the fields of its bases too, which draccus leaves out."""
    told = [(base.__doc__ or "").partition("Args:\n")[2].partition("\n\n")[0] for base in config_class.__bases__]
    config_class.__doc__ = "\n".join([(config_class.__doc__ or "").rstrip(), *filter(None, map(str.rstrip, told)), ""])
    return config_class


def decode[Config](config_class: type[Config], values: Mapping[str, Any]) -> Config:
    """Make a configuration of plain values.

    Raises:
        InputError: they do not make one.
    """
    with as_input():
        check_kinds(config_class, values)
        return draccus.decode(config_class, values)


def check_kinds(kind: Any, value: Any, name: str = "") -> None:
    """Refuse what draccus turns into something else: true into 1, 1.10 into the text "1.1", [] into all defaults.

    Raises:
        InputError: the message names the field.
    """
    kinds = [*_alternatives(kind)]
    if isinstance(value, Mapping) and (chosen := [one for one in kinds if hasattr(one, "get_choice_class")]):
        known = chosen[0].get_known_choices()
        kinds = [known[value["type"]]] if value.get("type") in known else [Any]
        value = {field: one for field, one in value.items() if field != "type"}
    if all(map(_is_plain, kinds)) and not any(_fits(one, value) for one in kinds):
        wanted = " or ".join(dict.fromkeys(_WANTED.get(get_origin(one) or one, "a mapping") for one in kinds))
        hint = " (put it in quotation marks)" if TEXTS & {*kinds} and not isinstance(value, list | Mapping) else ""
        raise InputError(f"{name} must be {wanted.removesuffix(' or nothing')}, not {repr(value)[:LONGEST]}{hint}.")
    for one in kinds:
        of = get_args(one) or (Any,)
        if isinstance(value, Mapping) and is_dataclass(one):
            hints = _hints(one)
            inner = [(hints[field], each, field) for field, each in value.items() if field in hints]
        elif isinstance(value, Mapping):
            inner = [(of[-1], each, field) for field, each in value.items()]
        else:
            inner = [(of[0], each, "") for each in value] if isinstance(value, list) else []
        for kind_of, each, field in inner:
            check_kinds(kind_of, each, ".".join(filter(None, (name, str(field)))))


def _hints(config_class: type) -> dict[str, Any]:
    """The kinds of its fields, that of the default among them: LeRobot calls some truths whole numbers."""
    hints = get_type_hints(config_class)
    given = {one.name: type(one.default) for one in fields(config_class) if one.default is not MISSING}
    own = {one.name: hints[one.name] for one in fields(config_class)}
    return {name: Union[kind, given.get(name, kind)] for name, kind in own.items()}  # noqa: UP007


TEXTS = {str, Path, NoneType}
_WANTED = NAMES | {float: "a number", NoneType: "nothing", list: "a list", tuple: "a list"}
"""What a value of a kind is called; others are mappings. Whether a number is finite is for `bounds`."""


def _is_plain(kind: Any) -> bool:
    return kind in (*_WANTED, dict) or get_origin(kind) in (list, tuple, dict) or is_dataclass(kind)


def _fits(kind: Any, value: Any) -> bool:
    """Whether a value of YAML or JSON is of a plain kind. 1e-4 is text in YAML."""
    match value:
        case None:
            return not is_dataclass(kind)
        case bool():
            return kind is bool
        case int():
            return kind in (int, float)
        case float():
            return kind is float
        case str():
            return kind in TEXTS or (kind is float and _is_number(value))
        case list() | tuple():
            return (get_origin(kind) or kind) in (list, tuple)
        case Mapping():
            return is_dataclass(kind) or (get_origin(kind) or kind) is dict
    return True


def _is_number(text: str) -> bool:
    try:
        float(text)
    except ValueError:
        return False
    return True


def _alternatives(kind: Any) -> Iterable[Any]:
    if get_origin(kind) in (Union, UnionType):
        return (one for each in get_args(kind) for one in _alternatives(each))
    return (kind,)


@contextmanager
def as_input() -> Iterator[None]:
    """Turn what the block raises into an `InputError`, but for `OSError` and for errors of our own configurations."""
    try:
        yield
    except (OSError, InputError):
        raise
    except FieldError as error:
        raise InputError(str(error)) from None
    except (TypeError, AttributeError):  # draccus merges fields, and copies them, before it looks at them
        raise InputError("The configuration's file is empty or is not a mapping of fields.") from None
    except Exception as error:  # those of draccus, argparse and YAML have no base in common
        root = error
        while root.__cause__ is not None:
            root = root.__cause__
        if isinstance(root, FieldError):
            raise InputError(str(root)) from None
        refusals = [frame for frame in traceback.extract_tb(root.__traceback__) if frame.name == "__post_init__"]
        if refusals and Path(refusals[-1].filename).is_relative_to(OURS):
            raise root from None  # a configuration of ours, which refuses the values or is broken itself
        raise InputError(str(error if isinstance(error, draccus.utils.DecodingError) else root)) from error
