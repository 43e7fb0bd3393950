"""Noise models, and the covariance that DART fits to a policy's errors."""

import numpy as np
import pytest

from lerobot_constructskill.contract import held_out
from lerobot_constructskill.demos.expert import Phase
from lerobot_constructskill.demos.noise import NoiseConfig, execute
from lerobot_constructskill.parsing import parse
from lerobot_constructskill.scripts.expert import CheckTaskConfig, FilmConfig
from lerobot_constructskill.scripts.held_out import fit_covariance

COVARIANCE = np.array([[9.0, 3.0, 0.0], [3.0, 4.0, -1.0], [0.0, -1.0, 1.0]]) * 1e-6
FITTED = COVARIANCE.tolist()
MODELS = {
    "off": (NoiseConfig(sigma=0.0), np.zeros((3, 3))),
    "fixed": (NoiseConfig("fixed", sigma=0.002), 4e-6 * np.eye(3)),
    "isotropic": (NoiseConfig("isotropic", covariance=FITTED), 14e-6 / 3 * np.eye(3)),
    "dart": (NoiseConfig("dart", covariance=FITTED), COVARIANCE),
}


@pytest.mark.parametrize("model", MODELS)
def test_noise_has_the_covariance_of_its_model(model):
    config, expected = MODELS[model]
    rng, clean = np.random.default_rng(0), np.array([0.0, 0.01, -0.02, 1.0])
    noise = np.array([execute(clean, Phase.CARRY, config, rng) - clean for _ in range(20_000)])
    np.testing.assert_allclose(config.root @ config.root, expected, atol=1e-15)
    np.testing.assert_allclose(np.cov(noise[:, :3].T), expected, atol=3e-7)
    assert (noise[:, 3] == 0).all()


@pytest.mark.parametrize("config_class", [CheckTaskConfig, FilmConfig])
def test_what_is_without_noise_stays_so_where_another_flag_of_noise_is_given(config_class):
    """draccus fills the rest in from the class, not from the default value."""
    for flags in ([], ["--noise.clip=0.05"], ["--noise.release_sigma=0.003"]):
        task = ["--task=brick_to_bin"]
        assert parse(config_class, task + flags).noise.sigma == 0
    assert parse(config_class, [*task, "--noise.sigma=0.01"]).noise.sigma == 0.01


def test_noise_in_release_ends_when_the_jaws_open_and_changes_no_other_phase():
    plain, shaken = NoiseConfig(sigma=0.002), NoiseConfig(sigma=0.002, release_sigma=0.004)
    closed, opened = np.array([0.0, 0.01, -0.02, -1.0]), np.array([0.0, 0.01, -0.02, 1.0])
    for phase in Phase:
        for action in (closed, opened):
            noise = [execute(action, phase, config, np.random.default_rng(7)) - action for config in (plain, shaken)]
            if phase is Phase.RELEASE and action is closed:
                np.testing.assert_allclose(noise[1][:3], 0.004 * np.random.default_rng(7).standard_normal(3))
            else:
                np.testing.assert_array_equal(*noise)


def test_a_covariance_without_full_rank_is_drawn_from():
    flat = np.outer([1, 2, 0], [1, 2, 0]) * 1e-6
    root = NoiseConfig("dart", covariance=flat.tolist()).root
    np.testing.assert_allclose(root @ root, flat, atol=1e-15)


@pytest.mark.parametrize(
    "bad, word",
    [
        ({"sigma": -0.01}, "-0.01"),
        ({"sigma": float("nan")}, "sigma"),
        ({"clip": 0}, "clip"),
        ({"phases": ["LFT"]}, "LIFT"),
        ({"model": "white"}, "isotropic"),
        ({"model": "dart"}, "constructskill-fit-noise"),
        ({"model": "dart", "covariance": [[1.0]]}, "3 x 3"),
        ({"model": "dart", "covariance": [[1.0, 2.0], [1.0]]}, "3 x 3"),
        ({"model": "dart", "covariance": [[1.0, 2.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]]}, "symmetric"),
        ({"model": "dart", "covariance": np.diag([1.0, 1.0, -1.0]).tolist()}, "negative"),
        ({"model": "dart", "covariance": np.diag([1.0, 1.0, np.nan]).tolist()}, "noise.covariance must be .* finite"),
    ],
)
def test_impossible_models_are_refused(bad, word):
    with pytest.raises(ValueError, match=word):
        NoiseConfig(**bad)


def test_the_covariance_of_a_policys_errors_is_found_and_every_episode_weighs_alike():
    rng = np.random.default_rng(0)
    long, short = (rng.multivariate_normal(np.zeros(3), c * COVARIANCE, n) for c, n in ((1, 40_000), (3, 10_000)))
    np.testing.assert_allclose(fit_covariance([long, short]), 2 * COVARIANCE, atol=4e-7)


def test_a_constant_bias_is_error_too():
    np.testing.assert_allclose(fit_covariance([np.full((5, 3), 0.01)]), np.full((3, 3), 1e-4))


def test_nothing_to_fit_is_told():
    with pytest.raises(ValueError, match="no frame"):
        fit_covariance([])


def test_every_eighth_episode_is_held_out():
    assert held_out(80) == [7, 15, 23, 31, 39, 47, 55, 63, 71, 79] and held_out(7) == []
    assert held_out([*"aabbab", *"b" * 4], 4) == [6] and held_out(["a"] * 9 + ["b"] * 9) == [7, 16]
