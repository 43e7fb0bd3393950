"""What a command prints for `--help`: draccus' flags, with what the configuration's own documentation says of each."""

import argparse
import re
import shutil
import textwrap
from collections.abc import Sequence
from dataclasses import MISSING, fields
from functools import partial
from inspect import cleandoc
from typing import Any

from lerobot_constructskill.parsing import Parser, kind_of
from lerobot_constructskill.presets import names

NARROWEST = 40
WIDTH = 100
"""Characters of the longest line, on a screen that has as many."""


def help_of(
    config_class: type, command: str, example: str, presets: str | None, first: Sequence[str], end: str
) -> str:
    """The help of a command.

    Args:
        config_class: the command's configuration.
        command: its name.
        example: one command line that can be copied.
        presets: kind of the shipped configurations that the first argument can name, one of `presets.KINDS`.
        first: fields whose values can stand before all flags.
        end: last lines.
    """
    parser = Parser(config_class, exit_on_error=False).parser
    by_name = {field.name: field for field in fields(config_class)}
    positional = [name.upper() if _is_required(by_name[name]) else f"[{name.upper()}]" for name in first]
    parser.prog = command
    parser.usage = " ".join(["%(prog)s", *(["[NAME]"] if presets else positional), "[--FLAG=VALUE ...]"])
    shipped = f"NAME is a file, or one of: {', '.join(names(presets))}." if presets else ""
    width = max(NARROWEST, min(WIDTH, shutil.get_terminal_size().columns) - 2)
    parser.description = f"example: {example}\n\n{_filled(_introduction(config_class), width)}"
    parser.epilog = _filled(f"{shipped}\n\n{end}".strip(), width)
    parser.formatter_class = partial(argparse.RawDescriptionHelpFormatter, max_help_position=26, width=width)
    options, *groups = [group for group in parser._action_groups if group._group_actions]
    for group in groups:
        owner = group._group_actions[0].dest.rpartition(".")[0]
        group.title, group.description = f"flags of {owner}" if owner else "flags", None
        for action in group._group_actions:
            name = action.dest.rpartition(".")[2]
            action.metavar = name.upper()
            action.help = _told(config_class, action, name not in first, presets)
    for action in options._group_actions:
        if action.dest == "config_path":
            action.help, action.metavar = "a YAML file of these flags; flags on the command line override it", "FILE"
        elif action.dest != "help":
            action.help = argparse.SUPPRESS  # draccus' "Config file for noise"
    return parser.format_help()


def _filled(text: str, width: int) -> str:
    return "\n\n".join(textwrap.fill(" ".join(part.split()), width) for part in text.split("\n\n"))


def _introduction(config_class: type) -> str:
    """The documentation of a configuration, without that of its fields and of what it raises."""
    return re.split(r"^(?:Args|Raises):\n", cleandoc(config_class.__doc__ or ""), maxsplit=1, flags=re.M)[0].strip()


def _told(config_class: type, action: argparse.Action, required: bool, presets: str | None) -> str:
    """What is said of a field: the comment beside it, or its line among `Args:`; and its default."""
    owner, _, name = action.dest.rpartition(".")
    config = kind_of(config_class, owner) if owner else config_class
    said = ((action.help or "").strip() or _arguments(config).get(name, "")).rstrip(".")
    field = next(one for one in fields(config) if one.name == name)
    if required and _is_required(field):
        said += " (required unless the file has it)" if presets else " (required)"
    elif "default" not in said and action.default not in (None, MISSING, argparse.SUPPRESS, "", [], (), {}):
        said += f" (default: {str(action.default).lower() if isinstance(action.default, bool) else action.default})"
    return said.strip().replace("%", "%%")


def _arguments(config_class: type) -> dict[str, str]:
    """Field to what the documentation of its class, or of a base, says of it."""
    told: dict[str, str] = {}
    for one in reversed(config_class.__mro__):
        block = re.search(r"^Args:\n((?:    .*\n?|\n)*)", cleandoc(one.__doc__ or ""), re.M)
        lines = re.findall(r"^    (\w+): (.*(?:\n {8}.*)*)", block[1] if block else "", re.M)
        told |= {name: " ".join(text.split()) for name, text in lines}
    return told


def _is_required(field: Any) -> bool:
    return field.default is MISSING and field.default_factory is MISSING
