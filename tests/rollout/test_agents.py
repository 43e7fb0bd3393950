"""What a policy does in an episode depends on that episode alone."""

import json
import os
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from lerobot.policies.factory import make_policy_config

from lerobot_constructskill.errors import InputError
from lerobot_constructskill.policies.frozen_vit.shared_encoder import BATCH, FrameCache
from lerobot_constructskill.rollout.agents import Lockstep, Observation, PolicyAgent, copies

SEEN = Observation({"pixels": {"base": np.zeros((1, 8, 8, 3), np.uint8)}}, {}, "put it there")


class Sampling(torch.nn.Module):
    """A policy that draws its actions, as Diffusion Policy does."""

    def __init__(self, use_amp=False):
        super().__init__()
        self.config = SimpleNamespace(device="cpu", use_amp=use_amp)

    def reset(self):
        pass

    def select_action(self, batch):
        self.in_amp = torch.is_autocast_enabled("cpu")
        return torch.randn(1, 4)


def agent():
    return PolicyAgent(Sampling(), lambda batch: batch, lambda action: action)


class Remembering(Sampling):
    """A policy whose submodule and processor remember: it acts by how many steps its episode has had."""

    def __init__(self):
        super().__init__()
        self.net = torch.nn.Linear(2, 2)
        self.net.steps = 0

    def reset(self):
        self.net.steps = 0

    def select_action(self, batch):
        self.net.steps += 1
        return torch.full((1, 4), self.net.steps + batch["seen"])


class Counting:
    """A processor that remembers, as LeRobot's relative actions do."""

    seen = 0

    def __call__(self, batch):
        self.seen += 1
        return {"seen": self.seen}


def test_copies_of_a_policy_that_remembers_share_its_weights_and_no_memory():
    agents = copies(PolicyAgent(Remembering(), Counting(), lambda action: action), 3)
    assert len({id(one.policy.net.weight) for one in agents}) == 1
    lockstep = Lockstep(agents)
    for step in range(1, 4):
        acts = lockstep.act(dict.fromkeys(range(3), SEEN))
        assert {float(act[0]) for act in acts.values()} == {2.0 * step}


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


@pytest.mark.parametrize("use_amp", [False, True])
def test_a_policy_acts_in_the_precision_that_lerobots_evaluation_would_use(use_amp):
    policy = Sampling(use_amp)
    PolicyAgent(policy, lambda batch: batch, lambda action: action).act(SEEN)
    assert policy.in_amp == use_amp


def test_a_policy_that_reads_what_it_is_not_shown_is_told_which_observation_has_it():
    policy = Sampling()
    policy.select_action = lambda batch: batch["observation.images.wrist"]
    with pytest.raises(InputError, match="reads observation.images.wrist.*obs_type=pixels_agent_pos") as refused:
        PolicyAgent(policy, lambda batch: batch, lambda action: action).act(SEEN)
    assert "\n" not in str(refused.value)
    policy.select_action = lambda batch: {}["a fault of the policy's own"]
    with pytest.raises(KeyError, match="of the policy's own"):
        PolicyAgent(policy, lambda batch: batch, lambda action: action).act(SEEN)


def test_an_adapter_is_no_policy(tmp_path):
    config = make_policy_config("act", device="cpu", use_peft=True, pretrained_backbone_weights=None)
    config.save_pretrained(tmp_path)
    with pytest.raises(InputError, match="is a PEFT adapter"):
        PolicyAgent.from_pretrained(tmp_path)


@pytest.mark.parametrize("new", [1, 15, 16, 17, 40])
def test_a_gpu_always_encodes_as_many_frames_at_once(new):
    """On a device without numbers: no GPU is needed to see what it would be given."""
    given = []

    def pool(batch):
        given.append(len(batch))
        return batch.flatten(1)

    memory = FrameCache(SimpleNamespace(pool=pool, backbone=SimpleNamespace(runtime="torch")))
    encoded = memory.encode([torch.empty(1, 3, 4, 4, device="meta")] * new)
    assert {*given} == {BATCH} and len(encoded) == new and encoded[0].shape == (1, 48)


def test_a_checkpoint_calls_nothing_that_is_not_registered(tmp_path):
    """LeRobot imports and calls whatever a step's `class` names."""
    ran = tmp_path / "ran"
    steps = [{"class": "os.system", "config": {"command": f"touch {ran}"}}]
    (tmp_path / "policy_preprocessor.json").write_text(json.dumps({"name": "x", "steps": steps}))
    with pytest.raises(InputError, match="steps.0.registry_name: it is missing"):
        PolicyAgent.from_pretrained(tmp_path)
    assert not ran.exists()
    (tmp_path / "policy_preprocessor.json").unlink()
    os.mkfifo(tmp_path / "model.safetensors")
    with pytest.raises(InputError, match="model.safetensors' is not a regular file"):
        PolicyAgent.from_pretrained(tmp_path)
