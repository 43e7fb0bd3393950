"""One thread inside, as many as before outside, whatever happens."""

import numpy as np
import pytest
import torch

from lerobot_constructskill.envs.gym_env import ConstructSkillEnv
from lerobot_constructskill.envs.vector_env import NativeVectorEnv
from lerobot_constructskill.threads import one_thread, threads


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


class StandInError(Exception):
    pass


class StandIn:
    """In place of ManiSkill's environment: notes the threads and ends there. Other tests step a real one."""

    def __init__(self):
        self.seen = []

    def reset(self, **_):
        self.seen.append(torch.get_num_threads())
        raise StandInError

    step = render = privileged_state = agent_state = lambda self, *_: self.reset()


def test_the_simulator_runs_in_one_thread_and_leaves_the_rest_to_its_user(monkeypatch):
    stand_in = StandIn()
    monkeypatch.setattr(ConstructSkillEnv, "make_scene", lambda self: stand_in)
    monkeypatch.setattr(ConstructSkillEnv, "started", lambda self: stand_in)
    env, native = ConstructSkillEnv(), NativeVectorEnv(1)
    action = np.zeros(4, np.float32)
    for call in (
        lambda: env.reset(seed=0),
        lambda: env.step(action),
        *(env.render, env.privileged_state, env.agent_state),
        lambda: native.reset(seed=0),
        lambda: native.step(action[None]),
    ):
        with pytest.raises(StandInError):
            call()
        assert torch.get_num_threads() == 3
    assert stand_in.seen == [1] * 7


def test_what_compiles_within_the_block_is_told_the_threads_outside():
    before = threads()
    with one_thread():
        assert torch.get_num_threads() == 1 and threads() == before
    assert torch.get_num_threads() == before == threads()
