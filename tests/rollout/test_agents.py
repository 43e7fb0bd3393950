"""What a policy does in an episode depends on that episode alone."""

from types import SimpleNamespace

import numpy as np
import torch

from lerobot_constructskill.rollout.agents import Lockstep, Observation, PolicyAgent

SEEN = Observation({"pixels": {"base": np.zeros((1, 8, 8, 3), np.uint8)}}, {}, "put it there")


class Sampling(torch.nn.Module):
    """A policy that draws its actions, as Diffusion Policy does."""

    config = SimpleNamespace(device="cpu")

    def reset(self):
        pass

    def select_action(self, batch):
        return torch.randn(1, 4)


def agent():
    return PolicyAgent(Sampling(), lambda batch: batch, lambda action: action)


def actions(seed, others):
    """Three steps of an episode beside episodes of `others`."""
    agents = [agent() for _ in (seed, *others)]
    for one, start in zip(agents, (seed, *others), strict=True):
        one.reset(start)
    lockstep = Lockstep(agents)
    return np.array([lockstep.act(dict.fromkeys(range(len(agents)), SEEN))[0] for _ in range(3)])


def test_a_policy_that_samples_draws_from_its_episode_and_step_alone():
    torch.manual_seed(0)
    alone = actions(5000, [])
    np.testing.assert_array_equal(actions(5000, [5001, 5000]), alone)
    assert len(np.unique(alone)) == alone.size and not np.isin(actions(5001, []), alone).any()
    drawn = torch.randn(1)
    torch.manual_seed(0)
    assert torch.randn(1) == drawn, "and leaves everybody else's draws alone"
