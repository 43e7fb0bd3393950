"""Copies of a process: they keep a state, and say so when they die."""

import os
import signal

import pytest

from lerobot_constructskill.board.forks import Fork, in_fork
from lerobot_constructskill.errors import MachineError


def count(state: list[int]) -> int:
    state[0] += 1
    return state[0]


def die(state: list[int] | None = None) -> None:
    os.kill(os.getpid(), signal.SIGKILL)


def test_a_fork_keeps_its_state_whatever_becomes_of_it_here_or_in_an_answer():
    state = [0]
    fork = Fork(state)
    try:
        state[0] = 5
        assert [fork.ask(count), fork.ask(count), in_fork(lambda: count(state)), state[0]] == [1, 1, 6, 5]
    finally:
        fork.close()


@pytest.mark.parametrize("again", [False, True])
def test_a_fork_that_dies_is_the_machines_failure(again):
    fork = Fork([0])
    try:
        for _ in range(1 + again):
            with pytest.raises(MachineError):
                fork.ask(die)
    finally:
        fork.close()
    with pytest.raises(MachineError):
        in_fork(die)
