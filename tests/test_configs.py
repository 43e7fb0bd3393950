"""Every shipped YAML is read by the class it is for, and says what it claims to say."""

import math
import re
from dataclasses import replace
from pathlib import Path

import draccus
import pytest
from lerobot.configs import PreTrainedConfig
from lerobot.configs.train import TrainPipelineConfig

import lerobot_constructskill.plugin  # noqa: F401
from lerobot_constructskill.demos.recorder import GenerateConfig
from lerobot_constructskill.envs.configuration_constructskill import ConstructSkillEnvConfig
from lerobot_constructskill.policies.frozen_vit.backbones import BACKBONES
from lerobot_constructskill.scripts.study import StudyConfig

CONFIGS = Path(__file__).parents[1] / "configs"
GENERATE = sorted((CONFIGS / "generate").glob("*.yaml"))
DOSE = sorted((CONFIGS / "dose").glob("*.yaml"))
STUDIES = sorted((CONFIGS / "study").glob("*.yaml"))
TRAIN = sorted((CONFIGS / "train").glob("*.yaml"))


def generate_config(path: Path) -> GenerateConfig:
    return draccus.parse(GenerateConfig, path, args=["--repo_id=local/set"])


@pytest.mark.parametrize("path", GENERATE, ids=lambda path: path.stem)
def test_generation_configs_are_the_papers(path):
    config = generate_config(path)
    assert config.task == ("brick_to_bin_shifted" if path.stem.endswith("shifted") else "brick_to_bin")
    assert config.episodes == (2 if path.stem == "smoke" else 80)
    assert config.noise.root[0, 0] == (0.0 if path.stem.endswith("noise_free") else 0.01)


@pytest.mark.parametrize("path", [path for path in GENERATE if path.stem.endswith("noise_free")], ids=lambda p: p.stem)
def test_a_noise_free_twin_differs_in_its_noise_alone(path):
    twin = generate_config(path.with_stem(path.stem.removesuffix("_noise_free")))
    config = generate_config(path)
    assert replace(config, noise=twin.noise) == twin


def test_executed_labels_differ_from_fast_in_the_labels_alone():
    fast, executed = (generate_config(CONFIGS / "generate" / f"fast{end}.yaml") for end in ("", "_executed_labels"))
    assert executed.labels == "executed" and replace(executed, labels="clean") == fast


@pytest.mark.parametrize("path", STUDIES, ids=lambda path: path.stem)
def test_a_study_names_data_sets_that_exist_and_policies_that_lerobot_knows(path):
    plan = draccus.parse(StudyConfig, path, args=[]).plan
    data = [s.data for s in plan.settings.values()] + [v.data for v in plan.variants.values() if v.data]
    assert all((CONFIGS.parent / file).is_file() for file in data)
    for setting in plan.settings.values():
        assert ConstructSkillEnvConfig(**setting.env).task == generate_config(CONFIGS.parent / setting.data).task
    for variant in plan.variants.values():
        assert draccus.decode(PreTrainedConfig, variant.policy).type == variant.policy["type"]


def test_the_papers_study_is_its_52_runs():
    plan = draccus.parse(StudyConfig, CONFIGS / "study" / "paper.yaml", args=[]).plan
    assert len(plan.runs) == 52 and plan.episodes == 10 and len(plan.pairs) == 6
    backbones = {variant.policy["backbone"] for variant in plan.variants.values() if variant.seeds == 10}
    assert backbones == set(BACKBONES)
    cut = draccus.parse(StudyConfig, CONFIGS / "study" / "dense.yaml", args=["--seeds=4"]).plan
    assert {variant.seeds for variant in cut.variants.values()} == {4} and max(cut.references.values()) == 4


def test_the_dose_response_is_six_doses_of_fast():
    fast = generate_config(CONFIGS / "generate" / "fast.yaml")
    doses = {int(re.search(r"\d+", path.stem)[0]): generate_config(path) for path in DOSE}
    assert list(doses) == [0, 2, 5, 10, 20, 30]
    for millimetres, config in doses.items():
        assert config == replace(fast, noise=replace(fast.noise, sigma=millimetres / 1000))


@pytest.mark.parametrize("path", TRAIN, ids=lambda path: path.stem)
def test_training_configs_hold_out_every_eighth_episode_and_no_other(path):
    config = draccus.parse(TrainPipelineConfig, path, args=[])
    episodes = config.dataset.episodes
    n_held_out = math.ceil(len(episodes) * config.dataset.eval_split)
    assert sorted(episodes) == list(range(len(episodes)))
    assert episodes[-n_held_out:] == [i for i in range(len(episodes)) if i % 8 == 7]
    assert config.eval_steps == config.steps
