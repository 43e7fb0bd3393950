"""Simulators whose processes die."""

from multiprocessing import Pipe

import pytest

from lerobot_constructskill.errors import MachineError
from lerobot_constructskill.rollout.simulators import Simulators


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
