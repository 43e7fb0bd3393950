"""Runs a console command: a configuration from flags and YAML, and one sentence for whatever goes wrong."""

import argparse
import logging
import os
import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from functools import cache, partial
from itertools import takewhile
from pathlib import Path
from typing import NoReturn, get_type_hints

from lerobot_constructskill.errors import (
    InputError,
    MachineError,
    UserError,
    full_traceback,
    keep_traceback,
    one_line,
    remedy_of,
)
from lerobot_constructskill.presets import find

REFUSED, FAULT, INTERRUPTED = 1, os.EX_SOFTWARE, 130
"""Exit statuses: something the user can fix; a fault of this package; Ctrl-C."""

LONGEST = 2000
"""Largest number of characters of a sentence; the log has all of it."""

DEBUG = "--debug"
EPILOG = f"{DEBUG} prints the traceback of whatever goes wrong. A log in ~/.local/state/constructskill always has it."


class Parser(argparse.ArgumentParser):
    """Parser of a command without a configuration, whose refusals are one sentence too."""

    def error(self, message: str) -> NoReturn:
        raise InputError(message)


def run[Config](
    config_class: type[Config],
    action: Callable[[Config], str],
    example: str,
    presets: str | None = None,
    first: Sequence[str] = (),
) -> None:
    """Parse `config_class` from the command line and print what `action` returns, inside `edge`.

    Where `presets` is a kind of shipped configurations, one of them, or a file, can stand before all flags. `first`
    are fields whose values can stand there, in this order and without their names. `example` is a line of `--help`.
    """
    with edge():
        if {"-h", "--help"} & {*sys.argv[1:]}:
            from lerobot_constructskill.scripts.usage import help_of

            say(help_of(config_class, Path(sys.argv[0]).name, example, presets, first, EPILOG).rstrip())
        else:
            from lerobot_constructskill.parsing import parse

            flags = _name_values(sys.argv[1:], ("config_path",) if presets else first, presets)
            say(action(parse(config_class, flags)))


def command[Config](
    example: str, presets: str | None = None, first: Sequence[str] = ()
) -> Callable[[Callable[[Config], str]], Callable[[Config], str]]:
    """Give a function that takes a configuration, its argument `config`, a `main` that is its console command.

    `example`, `presets` and `first` are those of `run`.
    """

    def with_main(action: Callable[[Config], str]) -> Callable[[Config], str]:
        action.main = partial(run, get_type_hints(action)["config"], action, example, presets, first)
        return action

    return with_main


def _name_values(flags: list[str], first: Sequence[str], presets: str | None) -> list[str]:
    """Put the names of fields before values that come before all flags; of `presets` a value is a name or a file."""
    values = list(takewhile(lambda flag: not flag.startswith("-"), flags if first else ()))
    if len(values) > len(first):
        raise InputError(
            f"{len(values)} values stand before the flags, where {' and '.join(first)} can stand: put a pattern in "
            "quotation marks, so that the shell leaves it alone."
        )
    named, others = [], flags[len(values) :]
    for name, value in zip(first, values, strict=False):
        if any(flag.split("=")[0] == f"--{name}" for flag in others):
            raise InputError(f"'{value}' and --{name} are two values of one field; give only one.")
        named.append(f"--{name}={find(presets, value) if presets else value}")
    return [*named, *others]


@contextmanager
def edge() -> Iterator[None]:
    """Turn what a command raises into one sentence and an exit status, and keep the traceback in a log."""
    # Torch reads this when it is imported. By default its threads spin while they wait for each other.
    os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")
    command, debug = list(sys.argv), DEBUG in sys.argv
    sys.argv = [argument for argument in sys.argv if argument != DEBUG]
    logging.getLogger().addFilter(_is_worth_printing)
    _open_streams()
    _silence_destructors()
    try:
        yield
        if _output_errors:
            said = f"standard output cannot be written to ({_output_errors.pop().strerror}); the work is done"
            raise MachineError(said)
    except (Exception, KeyboardInterrupt) as error:
        sys.exit(_report(error, command, debug))


def _open_streams() -> None:
    """Open streams that the shell has closed, and escape letters that its locale lacks."""
    for number, name in enumerate(("stdin", "stdout", "stderr")):
        if getattr(sys, name) is None:
            with suppress(OSError):  # else the next file gets the number of the stream, and its output
                os.dup2(os.open(os.devnull, os.O_RDWR), number)
            setattr(sys, name, open(os.devnull, "r+", encoding="utf-8"))  # noqa: SIM115  for good
    for stream in (sys.stdout, sys.stderr):
        if hasattr(stream, "reconfigure"):
            with suppress(OSError):  # of a stream that another program has put in its place
                stream.reconfigure(errors="backslashreplace")


@cache
def _silence_destructors() -> None:
    """Silence tracebacks of an `OSError` in destructors: PyAV's would repeat the sentence about a full disk."""
    of_errors, of_destructors = sys.excepthook, sys.unraisablehook
    sys.excepthook = lambda kind, error, trace: isinstance(error, OSError) or of_errors(kind, error, trace)
    sys.unraisablehook = lambda said: isinstance(said.exc_value, OSError) or of_destructors(said)


def say(text: str) -> None:
    """Print a text. If standard output cannot be written to, the work goes on, and `edge` reports why at its end.

    A reader that has closed the pipe, such as `head`, is no error.
    """
    try:
        print(text, flush=True)
    except OSError as error:
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        if not isinstance(error, BrokenPipeError):
            _output_errors.append(error)


_output_errors: list[OSError] = []
"""The error of writing to standard output, if there was one."""


def _is_worth_printing(record: logging.LogRecord) -> bool:
    """Whether a record is worth printing; LeRobot warns at every policy that there is no GPU."""
    return not record.getMessage().startswith("No accelerated backend detected")


def _report(error: BaseException, command: list[str], debug: bool) -> int:
    """Tell the user, keep the traceback, and return the exit status."""
    name, told = Path(command[0]).stem, full_traceback(error)
    log = keep_traceback(command, told)
    if debug or log is None:
        print(told, file=sys.stderr)
    status, sentence = _status_and_sentence(error)
    if status == FAULT:
        sentence += f"; the traceback is {'above' if log is None else f'in {log}'}"
    print(f"{name}: {sentence}", file=sys.stderr)
    return status


def _status_and_sentence(error: BaseException) -> tuple[int, str]:
    said = one_line(error)
    said = said if len(said) <= LONGEST else f"{said[:LONGEST]}..."
    if isinstance(error, KeyboardInterrupt):
        return INTERRUPTED, "interrupted"
    if isinstance(error, UserError | OSError):
        return REFUSED, said
    if isinstance(error, ModuleNotFoundError) and not str(error.name).startswith("lerobot_constructskill"):
        return REFUSED, remedy_of(error) or f"{said}; constructskill-doctor says what is not installed"
    return FAULT, f"this is a fault of constructskill, not of your input: {type(error).__name__}: {said}"
