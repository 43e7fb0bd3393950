"""Simulators whose processes die."""

import os
import signal
from concurrent.futures import Future
from concurrent.futures.process import BrokenProcessPool

import pytest

from lerobot_constructskill.errors import MachineError
from lerobot_constructskill.rollout.simulators import Simulators, simulators


@pytest.mark.parametrize("submits", [False, True], ids=["before it was asked", "before it answered"])
def test_a_worker_that_died_is_one_sentence(submits):
    class Dying:
        """A pool whose process has gone, or goes as soon as it has been asked."""

        def submit(self, *asked):
            if not submits:
                raise BrokenProcessPool("gone")
            future = Future()
            future.set_exception(BrokenProcessPool("gone"))
            return future

    with pytest.raises(MachineError, match="A simulator's process died"):
        Simulators([Dying()]).step({0: None}).get()


def test_a_worker_is_deaf_to_ctrl_c_and_its_death_is_noticed():
    with simulators([{}], 1) as sims:
        (worker,) = sims._workers
        process = worker.submit(os.getpid).result()
        os.kill(process, signal.SIGINT)
        assert worker.submit(os.getpid).result() == process
        os.kill(process, signal.SIGKILL)
        with pytest.raises(MachineError, match="A simulator's process died"):
            sims.reset({0: 1}).get()
