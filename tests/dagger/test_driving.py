"""Episodes that a learner drives: who acts, whose label is kept, and that no episode depends on those beside it.

The simulator is the toy of the data sets' tests; driving, advice and columns are the real ones.
"""

from dataclasses import replace

import numpy as np
import pytest
from toy_simulators import toy_simulators

from lerobot_constructskill.contract import SIM_STATE, get_task
from lerobot_constructskill.dagger import driving
from lerobot_constructskill.dagger.settings import DaggerConfig
from lerobot_constructskill.demos.columns import EXPERT, LEARNER, dagger_features
from lerobot_constructskill.demos.expert import ExpertConfig, PrivilegedState, make_expert

TASK = get_task("brick_to_bin")
EXPERTS = make_expert(TASK, ExpertConfig())
ENV = {"task": "brick_to_bin", "obs_type": "pixels", "episode_length": 150}
SEEDS = [2_000_000, 2_000_001, 2_000_002]


@pytest.fixture(autouse=True)
def toys(monkeypatch):
    monkeypatch.setattr(driving, "simulators", toy_simulators)


class Wanderer:
    """A learner that goes where its episode's seed sends it, faster than the environment lets it."""

    def reset(self, seed):
        self.rng = np.random.default_rng(seed)

    def act(self, observation):
        return np.array([*self.rng.normal(0, 0.08, 3), self.rng.choice([-0.7, 1.3])])


def drive(beta, together=2, patience=20, expert=EXPERTS):
    settings = driving.Drive(number=1, beta=beta, patience=patience)
    episodes = driving.drive_all(Wanderer(), expert, ENV, SEEDS, settings, together)
    return {episode.seed: episode for episode in episodes}


def table(episode, name):
    return np.stack([frame[name] for frame in episode.frames])


def test_the_expert_alone_places_and_its_label_is_what_was_executed():
    for episode in drive(beta=1.0).values():
        assert episode.placed and {frame["dagger.actor"] for frame in episode.frames} == {EXPERT}
        np.testing.assert_array_equal(table(episode, "action"), table(episode, "dart.executed_action"))
        assert table(episode, "next.done").squeeze().tolist() == [False] * (len(episode.frames) - 1) + [True]


@pytest.mark.parametrize("beta", [0.0, 0.5])
def test_every_frame_has_the_experts_label_for_its_own_state_whoever_acted(beta):
    episodes = drive(beta)
    for episode in episodes.values():
        for frame in episode.frames:
            state = PrivilegedState(**{name: frame[f"sim.{name}"] for name in SIM_STATE})
            np.testing.assert_array_equal(frame["action"], EXPERTS.advise(state).action)
            assert np.array_equal(frame["action"], frame["dart.executed_action"]) or frame["dagger.actor"] == LEARNER
            wanted = frame["dart.executed_action"][:3] - frame["action"][:3]
            np.testing.assert_array_equal(frame["dart.noise"], wanted)
        executed = table(episode, "dart.executed_action")
        assert np.abs(executed[:, :3]).max() <= np.float32(0.1) and np.abs(executed[:, 3]).max() <= 1
    actors = [frame["dagger.actor"] for episode in episodes.values() for frame in episode.frames]
    assert np.mean([actor == EXPERT for actor in actors]) == pytest.approx(beta, abs=0.1)


def test_an_episode_does_not_depend_on_those_beside_it():
    alone, together = drive(0.5, together=1), drive(0.5, together=3)
    assert alone.keys() == together.keys() == set(SEEDS)
    for seed, episode in alone.items():
        assert len(episode.frames) == len(together[seed].frames)
        for name in ("action", "dart.executed_action", "observation.state", "observation.images.base", "dagger.actor"):
            np.testing.assert_array_equal(table(episode, name), table(together[seed], name))


class Despairing:
    """Knows no way from a height on."""

    def advise(self, state):
        return replace(EXPERTS.advise(state), hopeless=bool(state.tcp[2] > 0.19))


def test_an_episode_ends_where_the_expert_knows_no_way_and_those_frames_are_dropped():
    hopeful, despairing = drive(1.0), drive(1.0, patience=3, expert=Despairing())
    for seed, episode in despairing.items():
        assert not episode.placed and 0 < len(episode.frames) < len(hopeful[seed].frames)
        hopeless = table(episode, "dagger.hopeless").squeeze()
        assert not hopeless[-1] and episode.frames[-1]["next.done"].all()


def test_a_frame_has_the_columns_of_a_data_set():
    frame = drive(0.5)[SEEDS[0]].frames[0]
    assert frame.keys() == dagger_features(TASK, ["base"]).keys()


@pytest.mark.parametrize(
    "fields, word",
    [({"betas": []}, "betas"), ({"betas": [2.0]}, "betas"), ({"rounds": -1}, "rounds"), ({"policy": {}}, "type")],
)
def test_impossible_settings_are_refused(fields, word):
    with pytest.raises(ValueError, match=word):
        DaggerConfig(**{"repo_id": "local/set", "policy": {"type": "act"}} | fields)


def test_the_last_beta_holds_for_the_rounds_that_follow():
    config = DaggerConfig("local/set", {"type": "act"}, betas=[0.5, 0.1])
    assert [config.beta(number) for number in (1, 2, 3)] == [0.5, 0.1, 0.1]
