"""The natively vectorised environment, with the one copy that a CPU can step, beside the ordinary one.

That several copies freeze and are seeded one by one is tested on a scene of ours that stands in for PhysX on a GPU.
"""

import json

import numpy as np
import pytest
import torch
from lerobot.envs.utils import check_env_attributes_and_types, preprocess_observation

from lerobot_constructskill.contract import REWARD_LIFTED
from lerobot_constructskill.envs.configuration_constructskill import ConstructSkillEnvConfig
from lerobot_constructskill.envs.recording import COUNTS
from lerobot_constructskill.envs.vector_env import NativeVectorEnv
from lerobot_constructskill.errors import InputError

KWARGS = {"task": "block_to_bin", "obs_type": "pixels_agent_pos", "episode_length": 4}
ACTIONS = np.random.default_rng(0).uniform(-0.03, 0.03, size=(6, 1, 4)).astype(np.float32)


def trajectory(config, seed):
    (vector,) = config.create_envs(n_envs=1)["constructskill"].values()
    seen = [vector.reset(seed=[seed], options={"lerobot_new_rollout": True})]
    check_env_attributes_and_types(vector)
    assert json.loads(seen[0][-1]["contract"][0]) == vector.call("contract")[0]
    seen += [vector.step(action) for action in ACTIONS]
    assert vector.call("render")[0].dtype == np.uint8
    assert vector.unwrapped.metadata["render_fps"] == 20
    seen.append(vector.reset(seed=[seed + 1], options={"lerobot_new_rollout": True}))
    seen += [vector.step(action) for action in ACTIONS[: KWARGS["episode_length"]]]
    vector.close()
    vector.close()
    return seen


@pytest.mark.sim
def test_one_native_copy_equals_the_ordinary_environment_beyond_the_end():
    native = trajectory(ConstructSkillEnvConfig(**KWARGS, vectorization="native"), seed=3)
    ordinary = trajectory(ConstructSkillEnvConfig(**KWARGS), seed=3)
    again = len(ACTIONS) + 1
    for ours, theirs in zip(native, ordinary, strict=True):
        for a, b in zip(ours[1:-1], theirs[1:-1], strict=True):
            np.testing.assert_array_equal(a, b)
        np.testing.assert_array_equal(ours[-1]["is_success"], theirs[-1]["is_success"])
        a, b = (preprocess_observation(one[0]) for one in (ours, theirs))
        assert a.keys() == b.keys() and all(torch.equal(a[name], b[name]) for name in a)
    assert native[again - 1][3].all() and native[again - 1][1].sum() == 0


@pytest.mark.sim
@pytest.mark.skipif(torch.cuda.is_available(), reason="there is a GPU")
def test_several_copies_without_a_gpu_are_refused():
    with pytest.raises(OSError, match="Several environments in one simulator, or sim_backend=gpu, need a GPU"):
        NativeVectorEnv(2, **KWARGS).reset(seed=[0, 1])


class Scene:
    """Three copies whose episode ends after `ends` steps; the image is the number of steps since the seeded start."""

    ends = np.array([1, 3, 9])

    def reset(self, seed, options):
        self.seed, self.n, self.options = np.array(seed), 0, options
        return self._obs(), self._info()

    def step(self, actions):
        assert actions.shape == (3, 7)
        self.n += 1
        return self._obs(), torch.full((3,), REWARD_LIFTED), torch.tensor(self.n >= self.ends), None, self._info()

    def agent_state(self):
        return torch.zeros(3, 8)

    def _obs(self):
        pixel = torch.tensor(self.seed + self.n, dtype=torch.uint8).view(3, 1, 1, 1).expand(3, 224, 224, 3)
        return {"sensor_data": {name: {"rgb": pixel} for name in ("base", "wrist")}}

    def _info(self):
        return {
            "success": torch.tensor(self.n >= self.ends),
            "is_lifted": torch.tensor([True] * 3),
            **dict.fromkeys((*COUNTS, "cost"), torch.zeros(3)),
        }


def test_an_ended_episode_freezes_while_the_others_go_on(monkeypatch):
    vector = NativeVectorEnv(3, **KWARGS | {"episode_length": 5})
    monkeypatch.setattr(vector._single, "make_scene", Scene)
    obs, _ = vector.reset(seed=[10, 20, 30])
    assert obs["pixels"]["base"][:, 0, 0, 0].tolist() == [10, 20, 30]
    rewards, pixels, ended = [], [], []
    for _ in range(6):
        obs, reward, terminated, truncated, info = vector.step(np.zeros((3, 4), np.float32))
        rewards.append(reward)
        pixels.append(obs["pixels"]["base"][:, 0, 0, 0])
        ended.append(terminated | truncated)
    assert np.sum(rewards, axis=0).tolist() == [0.5, 1.5, 2.5]
    assert pixels[-1].tolist() == [11, 23, 35]
    assert np.sum(ended, axis=0).tolist() == [6, 4, 2] and info["is_success"].tolist() == [True, True, False]
    vector.reset(seed=[1, 2, 3])
    assert vector._single.started().options == {"reconfigure": True}, (
        "PhysX would keep the contacts of the last episode"
    )
    assert vector.call("task_description") == (vector._single.task_description,) * 3


def test_what_it_cannot_do_is_refused():
    with pytest.raises(InputError, match="vectorization=process"):
        NativeVectorEnv(1, perturb="sensor=3")
    with pytest.raises(InputError, match="1 environments need as many seeds, not 2"):
        NativeVectorEnv(1).reset(seed=[1, 2])
    for use in (NativeVectorEnv.render, lambda vector: vector.step(ACTIONS[0])):
        with pytest.raises(RuntimeError, match="reset"):
            use(NativeVectorEnv(1))
