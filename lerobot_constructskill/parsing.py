"""Configurations by draccus, from flags, files and plain values; what it cannot read is the user's to mend."""

import argparse
import json
import os
import shlex
import tempfile
import traceback
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import draccus
import yaml

from lerobot_constructskill import tags
from lerobot_constructskill.errors import FieldError, InputError
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

    A flag's value is YAML, or text where it is none: `--only=*/seed_0` is no alias.

    Raises:
        InputError: they do not make a configuration.
        MissingError: a `!policy` in the file names no shipped policy.
        OSError: the file cannot be opened.
    """
    named, flags = _take_config_path(flags)
    with as_input(), _plain(named or config_path) as file:
        parser = ArgumentParser(config_class, file, exit_on_error=False, epilog=epilog)
        return parser.parse_args([_readable(flag) for flag in flags])


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


@contextmanager
def _plain(path: Path | str | None) -> Iterator[Path | str | None]:
    """A configuration file as draccus can read it: without our tags. JSON and TOML have none."""
    if path is None or Path(path).suffix in (".json", ".toml"):
        yield path
        return
    with tempfile.NamedTemporaryFile("w", suffix=".yaml", encoding="utf-8") as file:
        yaml.safe_dump(tags.read(path), file, sort_keys=False, allow_unicode=True)
        file.flush()
        yield file.name


def _readable(flag: str) -> str:
    """A flag whose value YAML can read: in quotation marks where it cannot.

    `~/` is the home folder; a shell does not replace it behind an equals sign.
    """
    name, _, value = flag.partition("=")
    if value.startswith("~/"):
        flag = f"{name}={(value := os.path.expanduser(value))}"
    try:
        yaml.compose(value, Loader=yaml.SafeLoader)
    except yaml.YAMLError:
        return f"{name}={json.dumps(value)}"
    return flag


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
        return draccus.decode(config_class, fields)


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
