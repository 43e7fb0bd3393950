"""Checkpoints of any LeRobot policy are evaluated where the other side was, and are a side of later comparisons."""

import json
from pathlib import Path

import numpy as np
import pytest
import torch
from lerobot.configs import FeatureType, PolicyFeature
from lerobot.policies.act.configuration_act import ACTConfig
from lerobot.policies.factory import get_policy_class, make_pre_post_processors

from lerobot_constructskill.envs.recording import read_recordings
from lerobot_constructskill.errors import InputError
from lerobot_constructskill.scripts.compare import CompareConfig, compare

pytestmark = [pytest.mark.sim]

IMAGE, STATE = PolicyFeature(FeatureType.VISUAL, (3, 224, 224)), PolicyFeature(FeatureType.STATE, (8,))
ACTION = PolicyFeature(FeatureType.ACTION, (4,))
SMALL = {
    "chunk_size": 4,
    "n_action_steps": 2,
    "pretrained_backbone_weights": None,
    "dim_model": 32,
    "n_heads": 2,
    "dim_feedforward": 32,
}


def write_checkpoint(filled, folder: Path, seed: int) -> None:
    """Random weights, where `lerobot-train` leaves its last checkpoint."""
    filled.output_features = {"action": ACTION}
    torch.manual_seed(seed)
    policy = get_policy_class(filled.type)(filled)
    for part in (policy, *make_pre_post_processors(policy.config)):
        part.save_pretrained(folder / "checkpoints" / "last" / "pretrained_model")


@pytest.fixture(scope="module")
def sides(config, tmp_path_factory) -> str:
    """ACT on both cameras and the state, as anybody may have trained it, and a policy of ours on the base camera."""
    root = tmp_path_factory.mktemp("sides")
    images = {f"observation.images.{name}": IMAGE for name in ("base", "wrist")}
    act, ours = ACTConfig(device="cpu", input_features=images | {"observation.state": STATE}, **SMALL), config()
    ours.input_features = {ours.image_keys[0]: IMAGE}
    for seed, filled in enumerate((act, ours)):
        write_checkpoint(filled, root / f"seed_{seed}", seed)
    return f"{root}/seed_*"


def test_checkpoints_are_evaluated_in_a_studys_conditions_and_their_recordings_are_a_side(sides, study, tmp_path):
    published, out = study([3, 0, 3, 1], starts=range(2000, 2003)), tmp_path / "out"
    told = compare(CompareConfig(sides, published, episodes=2, out=out))
    assert "2 checkpoints, evaluated now" in told and "0 of 2" in told
    assert "starts 2000 to 2001 (2 of 3 that A or B has)" in told
    (first, second) = sorted((out / "a").iterdir())
    assert [first.name, second.name] == ["00_seed_0", "01_seed_1"]
    episodes, others = (read_recordings(folder / "block_to_bin_5.parquet") for folder in (first, second))
    assert [one.evaluation_seed for one in episodes] == [2000, 2001]
    conditions = {(one.task, one.episode_length, one.obs_type, one.steps) for one in (*episodes, *others)}
    assert conditions == {("block_to_bin", 5, "pixels_agent_pos", 5)}
    assert not np.array_equal(episodes[0].flat, others[0].flat)
    compare(CompareConfig(f"{out}/a/*", published, out=tmp_path / "again"))
    evaluated, read = (json.loads((root / "comparison.json").read_text()) for root in (out, tmp_path / "again"))
    for fact in ("conditions", "starts", "rates_a", "rates_b", "judgement"):
        assert read[fact] == evaluated[fact]
    assert read["a"]["versions"]["backend"] == evaluated["a"]["versions"]["backend"]


def test_checkpoints_are_compared_over_several_tasks_and_their_recordings_are_sides(sides, tmp_path):
    a, b = (sides.replace("*", str(seed)) for seed in range(2))
    env = {"task": "block_to_bin,brick_to_bin_shifted", "episode_length": 3, "obs_type": "pixels_agent_pos"}
    told = compare(CompareConfig(a, b, **env, episodes=1, out=tmp_path / "out"))
    again = compare(CompareConfig(f"{tmp_path}/out/a/*", f"{tmp_path}/out/b/*"))
    kept = read_recordings(tmp_path / "out" / "a" / "00_seed_0" / "brick_to_bin_shifted_3.parquet")
    assert [(one.task, one.evaluation_seed, one.steps) for one in kept] == [("brick_to_bin_shifted", 1000, 3)]
    for name in env["task"].split(","):
        assert f"{name:<24}1000 to 1000 (1)        0.0%" in told and f"{name:<24}1000 to 1000 (1)        0.0%" in again


def test_a_policy_that_would_not_be_shown_what_it_reads_is_refused_before_anything_runs(sides, tmp_path):
    first, out = sides.replace("*", "0"), tmp_path / "out"
    with pytest.raises(InputError, match="seed_0/.*reads observation.state; where it acts, obs_type has to be"):
        compare(CompareConfig(first, sides.replace("*", "1"), task="block_to_bin", episodes=1, out=out))
    assert not out.exists()
