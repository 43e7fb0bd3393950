"""Errors that are meant for the user, told apart from faults of ours, and their words. Standard library only.

A `UserError` is a sentence that says what is wrong with a request, a file or a machine, and what to do about it. Any
other exception that leaves the package is a defect of it, or an `OSError` of the operating system.
"""

import os
import re
import shlex
import sys
import tempfile
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from datetime import datetime
from importlib.metadata import PackageNotFoundError, requires
from pathlib import Path
from traceback import TracebackException
from types import TracebackType

DISTRIBUTION = "lerobot_env_constructskill"


class UserError(Exception):
    """A sentence for the user. Each kind of it is also the exception that Python's users expect there."""

    kind = "input"
    """What tables call such a failure."""


class InputError(UserError, ValueError):
    """A value, a file or a combination of them that cannot be used."""


class FieldError(UserError):
    """An `InputError` of a configuration that LeRobot's commands parse.

    It is no ValueError, because draccus replaces the message of a ValueError by "Couldn't instantiate class".
    """


class MissingError(UserError, FileNotFoundError):
    """Something that was named is not there."""

    kind = "missing"


class MissingWeightsError(MissingError):
    """No source has a backbone's weights."""

    kind = "weights"


class TakenError(UserError, FileExistsError):
    """Something is there already, or another process is making it."""

    kind = "taken"


class MachineError(UserError, OSError):
    """This machine, its network or the Hub does not do its part."""

    kind = "machine"


def remedy_of(error: ModuleNotFoundError) -> str | None:
    """How to install a package that one of our extras brings; None for any other package."""
    wanted = (error.name or "").partition(".")[0]
    with suppress(PackageNotFoundError):
        for requirement in requires(DISTRIBUTION) or ():
            package, extra = re.match(r"[\w.-]+", requirement)[0], re.search(r"extra == [\"']([\w-]+)", requirement)
            if extra and package.replace("-", "_") == wanted:
                return f"{wanted} is not installed; uv pip install '{DISTRIBUTION}[{extra[1]}]'."
    return None


def plural(n: int, noun: str) -> str:
    """A count with its noun: "1 run", "2 runs"."""
    return f"{n} {noun}" if n == 1 else f"{n} {noun}s"


def first_line(error: Exception) -> str:
    """The first line of an error's message, or the name of its class if there is no message."""
    return next(iter(str(error).strip().splitlines()), type(error).__name__)


@contextmanager
def as_field_error() -> Iterator[None]:
    """Re-raise an `InputError` as a `FieldError`, whose sentence LeRobot's commands print."""
    try:
        yield
    except InputError as error:
        raise FieldError(str(error)) from None


def kind_of(error: BaseException) -> str:
    """What tables call a failure: a `UserError`'s kind, "machine" for the operating system's, or "fault"."""
    if isinstance(error, UserError):
        return error.kind
    return "machine" if isinstance(error, OSError) else "fault"


def one_line(said: object) -> str:
    """A text or an exception's, whatever lines it has, as one line."""
    return " ".join(str(said).split())


def full_traceback(error: BaseException) -> str:
    """Every traceback of a chain of exceptions, also those that `raise ... from None` keeps from the reader."""
    whole = link = TracebackException.from_exception(error)
    while link is not None:
        link.__suppress_context__ = False
        link = link.__cause__ or link.__context__
    return "".join(whole.format())


def keep_traceback(command: Sequence[str], told: str) -> Path | None:
    """Add a traceback to a command's log, in the home folder or, where that cannot be written, in the temporary one.

    Returns:
        The log; None where that fails as well.
    """
    name = Path(command[0]).stem
    entry = f"{datetime.now():%Y-%m-%d %H:%M:%S}  {shlex.join(command)}\n{told}\n"
    state = Path(os.environ.get("XDG_STATE_HOME") or os.path.expanduser("~/.local/state"), "constructskill")
    for log in (state / f"{name}.log", Path(tempfile.gettempdir(), f"{name}-{os.getuid()}.log")):
        with suppress(OSError):
            log.parent.mkdir(parents=True, exist_ok=True)
            # A path need not be UTF-8, and a folder of everybody's may hold a link to a file of somebody's.
            mode = os.O_WRONLY | os.O_APPEND | os.O_CREAT | os.O_NOFOLLOW
            with open(os.open(log, mode, 0o600), "w", encoding="utf-8", errors="backslashreplace") as file:
                file.write(entry)
            return log
    return None


def print_user_errors_of_lerobot() -> None:
    """Make LeRobot's commands print a `UserError` as one sentence and keep its traceback in a log, as ours do.

    Other exceptions and other programs stay as they are.
    """
    others = sys.excepthook

    def tell(kind: type[BaseException], error: BaseException, trace: TracebackType | None) -> None:
        name, first = Path(sys.argv[0]).name, error
        while first.__cause__ is not None:  # draccus hands on what a configuration refuses in an exception of its own
            first = first.__cause__
        if not (isinstance(first, UserError) and name.startswith("lerobot-")):
            return others(kind, error, trace)
        log = keep_traceback(sys.argv, full_traceback(error))
        print(f"{name}: {one_line(first)} (traceback: {log})", file=sys.stderr)

    sys.excepthook = tell
