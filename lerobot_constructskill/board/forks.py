"""Copies of this process, which are the one exact snapshot of PhysX.

SAPIEN's `pack` keeps poses and velocities, but no contacts: after `unpack` a held object moves otherwise, and an
episode may end in another step. A forked process keeps all, in milliseconds.
"""

import warnings
from collections.abc import Callable
from functools import partial
from multiprocessing import get_context
from multiprocessing.process import BaseProcess
from typing import Any

from lerobot_constructskill.artifacts.pools import DIED, be_killed_with_parent
from lerobot_constructskill.errors import MachineError

LONGEST_S = 3600
"""Seconds after which a copy that has not answered hangs: every tenth step of a wall of 2,000 takes minutes."""


class Fork[State]:
    """A copy of this process that keeps a state as it is, and answers what is asked of it."""

    def __init__(self, state: State):
        self._pipe, theirs = get_context("fork").Pipe()
        self._process = _start(_serve, state, theirs)
        theirs.close()

    def ask[Result](self, work: Callable[[State], Result]) -> Result:
        """Call a function that can be pickled with the state, in a copy of the copy.

        Raises:
            OSError: a copy died.
        """
        try:
            self._pipe.send(work)
        except ConnectionError:
            raise MachineError(DIED) from None
        return _received(self._pipe)

    def close(self) -> None:
        self._process.kill()
        self._process.join()
        self._pipe.close()


def in_fork[Result](work: Callable[[], Result]) -> Result:
    """Call a function in a copy of this process, whose simulator goes its own way.

    Raises:
        OSError: the copy died.
    """
    receiver, sender = get_context("fork").Pipe(duplex=False)
    process = _start(_answer, work, sender)
    sender.close()
    try:
        return _received(receiver)
    finally:
        process.kill()
        process.join()


def _start(target: Callable[..., None], *args: object) -> BaseProcess:
    process = get_context("fork").Process(target=target, args=args)
    with warnings.catch_warnings(action="ignore", category=DeprecationWarning):  # of threads, which wait in C
        process.start()
    return process


def _received(pipe) -> Any:
    try:
        if pipe.poll(LONGEST_S):
            return pipe.recv()
    except (EOFError, ConnectionError):  # the latter of what died before it read what it was asked
        pass
    raise MachineError(DIED)


def _answer(work: Callable[[], object], pipe) -> None:
    be_killed_with_parent()
    pipe.send(work())


def _serve(state: object, pipe) -> None:
    be_killed_with_parent()
    while True:
        pipe.send(in_fork(partial(pipe.recv(), state)))
