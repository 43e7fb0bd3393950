"""`constructskill`: the list of our commands, and their version; `constructskill NAME` is `constructskill-NAME`."""

import platform
import sys
from importlib import import_module, metadata

from lerobot_constructskill.artifacts.digests import versions
from lerobot_constructskill.errors import DISTRIBUTION, InputError
from lerobot_constructskill.scripts.console import DEBUG, EPILOG, edge

PREFIX = "constructskill-"
RELIES_ON = ("lerobot", "torch", "mani_skill", "sapien")
"""Whose versions a report of a fault wants to tell."""


def commands() -> dict[str, metadata.EntryPoint]:
    """The other console commands, without their prefix."""
    ours = metadata.distribution(DISTRIBUTION).entry_points
    return {entry.name.removeprefix(PREFIX): entry for entry in ours if entry.name.startswith(PREFIX)}


def tell_versions() -> str:
    told = {"Python": platform.python_version(), **versions(*RELIES_ON)}
    return (
        f"constructskill {metadata.version(DISTRIBUTION)} ({', '.join(f'{name} {one}' for name, one in told.items())})"
    )


def overview() -> str:
    """How it is called, and a line for each command: what its module says of itself."""
    said = {name: import_module(entry.module).__doc__.splitlines()[0] for name, entry in commands().items()}
    lines = [f"  {name:<12}{text.partition(': ')[2]}" for name, text in said.items()]
    return "\n".join(
        ["usage: constructskill COMMAND [--help] [FLAGS]", "       constructskill --version", "", *lines, "", EPILOG]
    )


def find(name: str) -> metadata.EntryPoint:
    """A command by its name, with or without the prefix.

    Raises:
        InputError: there is none.
    """
    found = commands().get(name.removeprefix(PREFIX))
    if found is None:
        raise InputError(f"There is no command '{name}'; the commands are: {', '.join(commands())}.")
    return found


def main() -> None:
    debug = [DEBUG] * (DEBUG in sys.argv)  # which `edge` takes out
    with edge():
        match sys.argv[1:]:
            case [] | ["-h" | "--help"]:
                return print(overview())
            case ["--version"]:
                return print(tell_versions())
            case [name, *flags]:
                command = find(name)
                sys.argv = [command.name, *flags, *debug]
    command.load()()


if __name__ == "__main__":
    main()
