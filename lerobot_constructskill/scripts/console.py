"""The edge of the console commands: a configuration from flags and YAML, and whatever goes wrong as one sentence."""

import argparse
import logging
import os
import shlex
import sys
import tempfile
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from datetime import datetime
from itertools import takewhile
from pathlib import Path
from typing import NoReturn

from lerobot_constructskill.errors import InputError, UserError, full_traceback, remedy_of
from lerobot_constructskill.presets import find, names

REFUSED, FAULT, INTERRUPTED = 1, os.EX_SOFTWARE, 130
"""Exit statuses: something the user can fix; a fault of this package; Ctrl-C."""

DEBUG = "--debug"
EPILOG = f"{DEBUG} prints the traceback of whatever goes wrong; a log in ~/.local/state/constructskill always has it."


class Parser(argparse.ArgumentParser):
    """Of a command without a configuration: what it cannot parse is one sentence too."""

    def error(self, message: str) -> NoReturn:
        raise InputError(message)


def run[Config](
    config_class: type[Config],
    action: Callable[[Config], str],
    presets: str | None = None,
    first: Sequence[str] = (),
) -> None:
    """Parse `config_class` from the command line and print what `action` returns, inside `edge`.

    Where `presets` is a kind of shipped configurations, one of them, or a file, can stand before all flags. `first`
    are fields whose values can stand there, in this order and without their names.
    """
    with edge():
        from lerobot_constructskill.parsing import parse

        flags, epilog = _put_names(sys.argv[1:], first), EPILOG
        if presets:
            flags, epilog = _put_file(flags, presets), f"{_tell_names(presets)} {EPILOG}"
        print(action(parse(config_class, flags, epilog=epilog)))


def _put_names(flags: list[str], first: Sequence[str]) -> list[str]:
    """Put the names of fields before values that come before all flags."""
    values = list(takewhile(lambda flag: not flag.startswith("-"), flags if first else ()))
    if len(values) > len(first):
        raise InputError(
            f"Before the flags stand {' and '.join(first)}, not {len(values)} values: put a pattern in quotation "
            "marks, so that the shell leaves it alone."
        )
    return [*(f"--{name}={value}" for name, value in zip(first, values, strict=False)), *flags[len(values) :]]


def _put_file(flags: list[str], kind: str) -> list[str]:
    """Replace a name or file that comes before all flags by `--config_path`."""
    if not flags or flags[0].startswith("-"):
        return flags
    name, *others = flags
    if any(flag.split("=")[0] == "--config_path" for flag in others):
        raise InputError(f"'{name}' and --config_path are two configurations; give only one.")
    return [f"--config_path={find(kind, name)}", *others]


def _tell_names(kind: str) -> str:
    return f"Instead of --config_path, the first argument can be a file or a name: {', '.join(names(kind))}."


@contextmanager
def edge() -> Iterator[None]:
    """Turn what a command raises into one sentence and an exit status, and keep its traceback in a log."""
    # Torch reads it when it is imported. Else its threads spin while they wait for one that another process holds up.
    os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")
    command, debug = list(sys.argv), DEBUG in sys.argv
    sys.argv = [argument for argument in sys.argv if argument != DEBUG]
    logging.getLogger().addFilter(_is_news)
    try:
        yield
        sys.stdout.flush()
    except BrokenPipeError:  # of `| head`, which has read enough
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
    except (Exception, KeyboardInterrupt) as error:
        sys.exit(_report(error, command, debug))


def _is_news(record: logging.LogRecord) -> bool:
    """LeRobot warns at every policy that there is no GPU, as most of our users know of their machine."""
    return not record.getMessage().startswith("No accelerated backend detected")


def _report(error: BaseException, command: list[str], debug: bool) -> int:
    """Tell the user, keep the traceback, and return the exit status."""
    name, told = Path(command[0]).stem, full_traceback(error)
    log = _keep(name, f"{datetime.now():%Y-%m-%d %H:%M:%S}  {shlex.join(command)}\n{told}\n")
    if debug or log is None:
        print(told, file=sys.stderr)
    status, sentence = _judge(error)
    if status == FAULT:
        sentence += f"; the traceback is {'above' if log is None else f'in {log}'}"
    print(f"{name}: {sentence}", file=sys.stderr)
    return status


def _judge(error: BaseException) -> tuple[int, str]:
    said = " ".join(str(error).split())
    if isinstance(error, KeyboardInterrupt):
        return INTERRUPTED, "interrupted"
    if isinstance(error, UserError | OSError):
        return REFUSED, said
    if isinstance(error, ModuleNotFoundError) and not str(error.name).startswith("lerobot_constructskill"):
        return REFUSED, remedy_of(error) or f"{said}; constructskill-doctor says what is not installed"
    return FAULT, f"this is a fault of constructskill, not of your input: {type(error).__name__}: {said}"


def _keep(name: str, entry: str) -> Path | None:
    """Add to a command's log, or where the home folder cannot be written to a new one; None if that fails as well."""
    try:
        folder = Path(os.environ.get("XDG_STATE_HOME") or Path.home() / ".local/state") / "constructskill"
        folder.mkdir(parents=True, exist_ok=True)
        log = folder / f"{name}.log"
        with log.open("a") as file:
            file.write(entry)
        return log
    except (OSError, RuntimeError):  # Path.home raises the latter for a user who has none
        pass
    try:
        with tempfile.NamedTemporaryFile("w", prefix=f"{name}-", suffix=".log", delete=False) as file:
            file.write(entry)
        return Path(file.name)
    except OSError:
        return None
