"""The held-out error of any policy, on frames that are the same each time."""

import numpy as np
import pytest
import torch

from lerobot_constructskill.policies.frozen_vit import train_seeds
from lerobot_constructskill.rollout import offline
from lerobot_constructskill.rollout.agents import PolicyAgent

EPISODES = [3, 7]


@pytest.fixture(scope="module", params=[1, 5], ids="chunks of {}".format)
def trained(request, config, feature_set, tmp_path_factory):
    """A policy and its checkpoint."""
    folder = tmp_path_factory.mktemp("checkpoint") / "of_a_policy"
    fields = config(chunk_size=request.param)
    (policy,) = train_seeds.train_seeds(fields, feature_set, [0], epochs=2, batch_size=16, held_out=EPISODES)
    train_seeds.save_checkpoint(policy, feature_set, folder)
    return policy, folder


def test_it_is_of_what_is_held_out_alone(trained, feature_set):
    _, folder = trained
    apart = [offline.heldout_mse(folder, feature_set, [episode]) for episode in EPISODES]
    assert min(apart) <= offline.heldout_mse(folder, feature_set, EPISODES) <= max(apart)
    assert offline.heldout_mse(folder, feature_set, []) is None


def test_of_many_pictures_a_few_are_looked_at_that_lie_in_all_episodes(trained, feature_set, monkeypatch):
    """The features stand in for pictures, of which all would take long to encode."""
    _, folder = trained
    monkeypatch.setattr(type(feature_set.meta), "camera_keys", ["observation.images.base"])
    whole = offline.heldout_mse(folder, feature_set, EPISODES)
    asked = []
    real = offline._mean_square
    monkeypatch.setattr(offline, "FRAMES", 8)
    monkeypatch.setattr(offline, "_mean_square", lambda *given: asked.extend(given[2]) or real(*given))
    assert offline.heldout_mse(folder, feature_set, EPISODES) == pytest.approx(whole, rel=0.5)
    numbers = np.asarray(feature_set.hf_dataset.with_format("numpy")["episode_index"][:])
    assert len(asked) == 8 and set(numbers[asked]) == set(EPISODES) and np.diff(asked).min() > 0


def test_what_a_policy_samples_is_drawn_alike_each_time(trained, feature_set, monkeypatch):
    _, folder = trained
    real = PolicyAgent.from_pretrained

    def sampling(*given, **acting):
        agent = real(*given, **acting)
        certain = agent.policy.predict_action_chunk
        agent.policy.predict_action_chunk = lambda batch: torch.randn_like(certain(batch))
        return agent

    monkeypatch.setattr(PolicyAgent, "from_pretrained", sampling)
    first, second = (offline.heldout_mse(folder, feature_set, EPISODES) for _ in range(2))
    assert first == second
