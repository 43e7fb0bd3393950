"""Simulators whose processes die."""

import os
import signal
from multiprocessing import Pipe, get_context

import pytest

from lerobot_constructskill.errors import MachineError
from lerobot_constructskill.rollout.simulators import Simulators, _work


@pytest.mark.parametrize("reads", [False, True], ids=["before it was asked", "before it answered"])
def test_a_worker_that_died_is_one_sentence(reads):
    ours, theirs = Pipe()

    class Dying:
        """A worker's end that goes as soon as it has been asked, or before."""

        def send(self, asked):
            if not reads:
                theirs.close()
            ours.send(asked)
            theirs.close()

        recv = ours.recv

    with pytest.raises(MachineError, match="A simulator's process died"):
        Simulators([Dying()]).step({0: None})


def test_a_worker_is_deaf_to_ctrl_c_and_ends_when_the_other_side_hangs_up():
    ours, theirs = Pipe()
    worker = get_context("spawn").Process(target=_work, args=(theirs, []))
    worker.start()
    theirs.close()
    ours.send(("reset", {}))
    assert ours.recv() == {}  # it has begun
    os.kill(worker.pid, signal.SIGINT)
    ours.send(("reset", {}))
    assert ours.recv() == {}
    ours.close()
    worker.join()
    assert worker.exitcode == 0
