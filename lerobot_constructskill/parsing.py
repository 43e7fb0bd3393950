"""Configurations by draccus, from flags, files and plain values; what it cannot read is the user's to mend."""

import argparse
import os
import shlex
import tomllib
import traceback
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import is_dataclass
from pathlib import Path
from types import UnionType
from typing import Any, Union, get_args, get_origin, get_type_hints

import draccus
import mergedeep

from lerobot_constructskill import tags
from lerobot_constructskill.errors import FieldError, InputError
from lerobot_constructskill.files import Json, parse_yaml, read_text
from lerobot_constructskill.lerobot_internals import ArgumentParser
from lerobot_constructskill.presets import find

OURS = Path(__file__).parent


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
        return Parser(config_class, named or config_path, exit_on_error=False, epilog=epilog).parse_args(flags)


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
        said = draccus.utils.deflatten({name: _value(text) for name, text in vars(flags).items()}, sep=".")
        return decode(self.config_class, mergedeep.merge(_fields(self.config_path), said))


def _value(text: str) -> Any:
    """A flag's value is YAML, or text where it is none: `--only=*/seed_0` is no alias.

    `~/` is the home folder; a shell does not replace it behind an equals sign.
    """
    text = os.path.expanduser(text) if text.startswith("~/") else text
    try:
        return parse_yaml(text, "It") if text else text
    except InputError:
        return text


def _fields(path: Path | str | None) -> dict[str, Any]:
    if path is None:
        return {}
    suffix = Path(path).suffix
    if suffix == ".toml":
        return tomllib.loads(read_text(Path(path)))
    fields = Json("a configuration").read(Path(path)) if suffix == ".json" else tags.read(path)
    if not isinstance(fields, dict):
        raise InputError("The configuration's file is empty or is not a mapping of fields.")
    return fields


def tells_of_bases[Config](config_class: type[Config]) -> type[Config]:
    """Decorate a configuration so that its `--help` tells of the fields of its bases too, which draccus leaves out."""
    told = [(base.__doc__ or "").partition("Args:\n")[2].partition("\n\n")[0] for base in config_class.__bases__]
    config_class.__doc__ = "\n".join([(config_class.__doc__ or "").rstrip(), *filter(None, map(str.rstrip, told)), ""])
    return config_class


def decode[Config](config_class: type[Config], fields: Mapping[str, Any]) -> Config:
    """Make a configuration of plain values.

    Raises:
        InputError: they do not make one.
    """
    with as_input():
        _refuse_truths(config_class, fields)
        return draccus.decode(config_class, fields)


def _refuse_truths(kind: Any, value: Any, name: str = "") -> None:
    """Refuse true and false where a number belongs; draccus takes them for 1 and 0."""
    kinds = [*_alternatives(kind)]
    if isinstance(value, bool) and {int, float} & {*kinds} and not {bool, str, Any} & {*kinds}:
        raise InputError(f"{name} must be a number, not {str(value).lower()}.")
    for one in kinds:
        of = get_args(one) or (Any,)
        if isinstance(value, Mapping) and is_dataclass(one):
            hints = get_type_hints(one)
            inner = [(hints[field], each, field) for field, each in value.items() if field in hints]
        elif isinstance(value, Mapping):
            inner = [(of[-1], each, field) for field, each in value.items()]
        else:
            inner = [(of[0], each, "") for each in value] if isinstance(value, list) else []
        for kind_of, each, field in inner:
            _refuse_truths(kind_of, each, ".".join(filter(None, (name, str(field)))))


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
