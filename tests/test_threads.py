"""One thread inside, as many as before outside, whatever happens."""

import numpy as np
import pytest
import torch

from lerobot_constructskill.envs.gym_env import ConstructSkillEnv
from lerobot_constructskill.threads import one_thread


@pytest.fixture(autouse=True)
def three_threads():
    before = torch.get_num_threads()
    torch.set_num_threads(3)
    yield
    torch.set_num_threads(before)


def test_the_number_of_threads_comes_back():
    with pytest.raises(KeyError), one_thread():
        assert torch.get_num_threads() == 1
        raise KeyError
    assert torch.get_num_threads() == 3


def test_the_simulator_runs_in_one_thread_and_leaves_the_rest_to_its_user(monkeypatch):
    """Reset and step, which take whatever is simulated; another test steps a real one."""
    seen = []

    class StandInError(Exception):
        pass

    def record(*_):
        seen.append(torch.get_num_threads())
        raise StandInError

    monkeypatch.setattr(ConstructSkillEnv, "begin", record)
    monkeypatch.setattr(ConstructSkillEnv, "advance", record)
    env = ConstructSkillEnv()
    for call in (lambda: env.reset(seed=0), lambda: env.step(np.zeros(4, np.float32))):
        with pytest.raises(StandInError):
            call()
    assert seen == [1, 1] and torch.get_num_threads() == 3
