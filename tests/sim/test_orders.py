"""Orders: their pictures are the same, and the first placement counts."""

import numpy as np
import pytest

from lerobot_constructskill.contract import ORDERS
from lerobot_constructskill.envs.gym_env import ConstructSkillEnv

pytestmark = pytest.mark.sim

FIRST, *OTHERS = ORDERS
LAST = OTHERS.pop()


@pytest.mark.parametrize("other", [LAST, *(pytest.param(one, marks=pytest.mark.nightly) for one in OTHERS)])
def test_nothing_but_the_instruction_tells_an_order(other):
    envs = [ConstructSkillEnv(name) for name in (FIRST, other)]
    for seed in (0, 1):
        (one, _), (another, _) = (env.reset(seed=seed) for env in envs)
        assert np.array_equal(one["pixels"]["base"], another["pixels"]["base"])
    first, second = (env.step(np.array([0.05, -0.05, -0.02, -1], np.float32))[0] for env in envs)
    assert np.array_equal(first["pixels"]["base"], second["pixels"]["base"])
    for env in envs:
        env.close()


@pytest.mark.parametrize("misplaced_first", [False, True])
def test_only_the_first_placement_counts(misplaced_first):
    import torch
    from mani_skill.utils.structs import Pose

    env = ConstructSkillEnv("brick_to_grey", render_backend="none")
    env.reset(seed=0)
    scene, open_hand = env._env, np.array([0, 0, 0, 1], np.float32)

    def put(name: str, bin_name: str) -> dict:
        place = scene.all_bins[bin_name].pose.p + torch.tensor([[0, 0, scene.bin_interior[2] / 2]])
        scene.all_objects[name].set_pose(Pose.create_from_pq(place, torch.tensor([[1.0, 0, 0, 0]])))
        for _ in range(8):
            *_, info = env.step(open_hand)
        return info

    asked, other = ("brick", "grey"), ("block", "blue")
    for where in (other, asked) if misplaced_first else (asked, other):
        info = put(*where)
    assert info["is_success"] != misplaced_first
    assert bool(scene.evaluate()["is_misplaced"]) == misplaced_first
    env.close()
