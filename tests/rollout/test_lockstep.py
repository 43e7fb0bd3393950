"""Rollouts in lockstep are `lerobot-eval`'s, step for step, and a policy that fails takes none down with it."""

from contextlib import nullcontext
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from lerobot.configs import FeatureType, PolicyFeature
from lerobot.policies.factory import make_pre_post_processors
from lerobot.scripts.lerobot_eval import rollout

from lerobot_constructskill.contract import GRIPPER_CLOSED, get_task
from lerobot_constructskill.envs.configuration_constructskill import ConstructSkillEnvConfig
from lerobot_constructskill.envs.recording import COUNTS
from lerobot_constructskill.policies.frozen_vit.modeling_frozen_vit import FrozenViTChunkPolicy
from lerobot_constructskill.policies.frozen_vit.precision import native_precision
from lerobot_constructskill.rollout import lockstep
from lerobot_constructskill.rollout.agents import PolicyAgent
from lerobot_constructskill.rollout.lockstep import roll_out
from lerobot_constructskill.rollout.references import REFERENCES
from lerobot_constructskill.rollout.simulators import Step

pytestmark = [pytest.mark.sim]

IMAGE = PolicyFeature(FeatureType.VISUAL, (3, 224, 224))
STEPS, SEEDS = 7, [1000, 1001]
ENV = {"task": "block_to_bin", "episode_length": STEPS}  # a task whose initial state depends on the seed
NOTHING_YET = dict.fromkeys(("is_lifted", "is_in_bin", "is_success"), False) | dict.fromkeys((*COUNTS, "cost"), 0)


def random_agent(config, seed, **fields):
    torch.manual_seed(seed)
    filled = config(**fields)
    filled.input_features = {filled.image_keys[0]: IMAGE}
    policy = FrozenViTChunkPolicy(filled)
    return PolicyAgent(policy, *make_pre_post_processors(policy.config))


@pytest.fixture(scope="module")
def vector():
    (vector,) = ConstructSkillEnvConfig(**ENV).create_envs(n_envs=1)["constructskill"].values()
    yield vector
    vector.close()


def lerobots_actions(agent, vector, seed):
    """What `lerobot-eval` does with one environment, as (steps, A)."""
    same = [lambda batch: batch] * 2
    agent.policy.reset()
    ran = rollout(vector, agent.policy, *same, agent.preprocessor, agent.postprocessor, seeds=[seed])
    return ran["action"][0].numpy()


@pytest.mark.parametrize(
    "fields",
    [
        {"backbone_precision": "bfloat16"},
        {"backbone_precision": "float32"},
        {"temporal_ensemble_coeff": None, "n_action_steps": 4},
        {"readout": "spatial_softmax"},
    ],
    ids=str,
)
def test_lockstep_equals_lerobot_eval_step_for_step(fields, config, vector):
    if fields.get("backbone_precision") == "bfloat16":
        pytest.importorskip("openvino", reason="autocast's features depend on the batch")
        if native_precision("cpu") != "bfloat16":
            pytest.skip("this CPU only emulates bfloat16")
    agents = [random_agent(config, seed, **fields) for seed in range(2)]
    seen = {}
    keep = lambda i, episode, action, _: seen.setdefault((i, episode), []).append(action)  # noqa: E731
    outcomes = dict(roll_out(agents, ENV, [SEEDS] * len(agents), on_step=keep))
    assert all(len(outcome.episodes) == 2 and outcome.error is None for outcome in outcomes.values())
    assert len({id(agent.policy.backbone) for agent in agents}) == 1
    for (i, episode), actions in seen.items():
        np.testing.assert_array_equal(actions, lerobots_actions(agents[i], vector, SEEDS[episode]))
    assert not np.array_equal(seen[0, 0], seen[1, 0]) and not np.array_equal(seen[0, 0], seen[0, 1])


def test_a_policys_episodes_run_side_by_side_where_there_are_fewer_policies_than_places(config, monkeypatch):
    starts, opened, simulators = range(1000, 1005), [], lockstep.simulators
    monkeypatch.setattr(lockstep, "simulators", lambda envs, *how: opened.append(envs) or simulators(envs, *how))
    agent, other = (random_agent(config, seed) for seed in range(2))
    env = ENV | {"obs_type": "pixels_agent_pos"}
    ((_, alone),) = roll_out([agent], env, [starts], n_workers=1)
    ((_, shared),) = roll_out([agent], env, [starts], n_workers=2, filmed=[0])
    ((_, beside), _) = sorted(roll_out([agent, other], env, [starts] * 2, n_workers=1))
    cameras = [[one.get("cameras") for one in envs] for envs in opened]
    assert cameras == [[("base",)] * 2, [None, ("base",), ("base",)], [("base",)] * 2]
    for found in (shared, beside):
        assert str(found) == str(alone) and all(map(same_actions, found.episodes, alone.episodes))


class Broken:
    """Fails at its third step, or acts in a way that the environment refuses."""

    def __init__(self, action):
        self.action = action
        self.n = 0

    def reset(self, seed):
        self.n = 0

    def act(self, observation):
        self.n += 1
        if self.action is None and self.n == 3:
            raise ValueError("lost the plot")
        return np.zeros(4, dtype=np.float32) if self.action is None else self.action


def test_an_agent_that_cannot_see_or_begin_is_recorded_and_the_others_go_on(config, monkeypatch):
    unready, sightless, sharing = (random_agent(config, seed) for seed in range(3))

    def no_beginning(seed):
        raise RuntimeError("no beginning")

    def no_image(observation):
        raise KeyError("wrist")

    monkeypatch.setattr(unready, "reset", no_beginning)
    monkeypatch.setattr(sightless, "preprocessor", no_image)
    hover = Broken(np.array([0, 0, 0, GRIPPER_CLOSED], dtype=np.float32))
    lanes = [unready, hover, sightless, sharing]
    found = (rollout for _, rollout in sorted(roll_out(lanes, ENV, [SEEDS] * 4, n_workers=2)))
    not_begun, fine, unseen, seen = found
    assert "no beginning" in str(not_begun.error) and isinstance(unseen.error, KeyError)
    assert all(rollout.error is None and len(rollout.episodes) == len(SEEDS) for rollout in (fine, seen))


def test_an_encoder_that_fails_takes_those_with_it_that_share_it_and_no_other(config, monkeypatch):
    agents = [random_agent(config, seed) for seed in range(2)]
    pool = FrozenViTChunkPolicy.pool

    def out_of_memory(policy, images):
        if policy.config.crop is None:
            raise MemoryError("no room for the batch")
        return pool(policy, images)

    monkeypatch.setattr(FrozenViTChunkPolicy, "pool", out_of_memory)
    hover = Broken(np.array([0, 0, 0, GRIPPER_CLOSED], dtype=np.float32))
    others = [random_agent(config, 2, crop=[0.25, 0.25, 0.75, 0.75]), hover]
    *failed, other, still = (run for _, run in sorted(roll_out([*agents, *others], ENV, [SEEDS] * 4, n_workers=2)))
    assert [str(rollout.error) for rollout in failed] == ["no room for the batch"] * 2
    assert other.error is None and still.error is None


class Noting:
    """Environments of one step that note when they are asked, and when their answers are waited for."""

    def __init__(self, events):
        self.events = events

    def reset(self, seeds):
        return self._answers("reset", seeds, done=False)

    def step(self, actions):
        return self._answers("step", actions, done=True)

    def _answers(self, what, asked, done):
        for number in asked:
            self.events.append((what, number))
        sim = {"object_pose": np.zeros(7), "bin_position": np.zeros(3)}
        told = {number: Step({}, sim, done, NOTHING_YET) for number in asked}

        def get():
            for number in asked:
                self.events.append(("answered", number))
            return told

        return SimpleNamespace(get=get)


def test_agents_of_one_half_act_while_the_environments_of_the_other_are_at_work(monkeypatch):
    events = []

    class Acting(Broken):
        def __init__(self, number):
            super().__init__(np.zeros(4, dtype=np.float32))
            self.number = number

        def act(self, observation):
            events.append(("act", self.number))
            return super().act(observation)

    monkeypatch.setattr(lockstep, "simulators", lambda *_: nullcontext(Noting(events)))
    outcomes = dict(roll_out([Acting(number) for number in range(4)], ENV, [SEEDS] * 4))
    assert all(outcome.error is None and len(outcome.episodes) == len(SEEDS) for outcome in outcomes.values())
    at_work, meanwhile = set(), set()
    for what, number in events:
        if what in ("reset", "step"):
            at_work.add(number)
        elif what == "answered":
            at_work.discard(number)
        elif what == "act":
            meanwhile |= {(number, other) for other in at_work}
    assert meanwhile == {(mine, other) for mine in (0, 1) for other in (2, 3)} | {(2, 0), (2, 1), (3, 0), (3, 1)}


def test_agents_that_all_fail_at_once_are_recorded():
    class Unready:
        def reset(self, seed):
            raise RuntimeError("no beginning")

    outcomes = dict(roll_out([Unready() for _ in range(3)], ENV, [SEEDS] * 3, n_workers=1))
    assert len(outcomes) == 3 and all("no beginning" in str(one.error) for one in outcomes.values())


class Looking(Broken):
    """Notes the cameras that it is shown."""

    def __init__(self, cameras):
        super().__init__(np.array([0, 0, 0, GRIPPER_CLOSED], dtype=np.float32))
        self.cameras = cameras

    def act(self, observation):
        self.seen = tuple(observation.seen["pixels"])
        return super().act(observation)


def test_an_agent_is_shown_what_it_looks_at_and_who_is_filmed_or_does_not_say_every_camera(config, monkeypatch):
    policy = random_agent(config, 0, camera="wrist")
    unsaid = Looking(None)
    del unsaid.cameras
    agents = [Looking(("wrist",)), Looking(("wrist",)), Looking(()), Looking(policy.cameras), unsaid]
    env = ENV | {"obs_type": "pixels_agent_pos"}
    outcomes = dict(roll_out(agents, env, [SEEDS[:1]] * 5, n_workers=2, filmed=[1]))
    assert all(outcome.error is None for outcome in outcomes.values())
    both = ("base", "wrist")
    assert [agent.seen for agent in agents] == [("wrist",), both, ("base",), ("wrist",), both]
    monkeypatch.setattr(policy, "preprocessor", SimpleNamespace(steps=[SimpleNamespace(rename_map={"here": "there"})]))
    assert policy.cameras == both
    monkeypatch.undo()
    policy.policy.config.input_features = {"observation.images.top": IMAGE}
    assert policy.cameras == both


def same_actions(one, other):
    return np.array_equal(np.concatenate(one.actions), np.concatenate(other.actions))


@pytest.mark.parametrize(("name", "workers"), [("random", 1), ("expert", 2)])
def test_an_agent_that_looks_at_no_camera_has_the_episodes_that_it_has_one_after_another(name, workers):
    """They are shared out, and only the first is rendered; perturbed, as no draw may depend on pictures."""
    perturb = "camera=1,light=1,texture=1,distractors=1,pose=1"
    env = {"task": "course_of_three", "obs_type": "pixels_agent_pos", "episode_length": 40, "perturb": perturb}
    starts, task = range(1000, 1005), get_task("course_of_three")
    agent, looking = (REFERENCES[name].agent(task, 0, None) for _ in range(2))
    looking.cameras = ("base",)
    shown = []
    keep = lambda number, episode, _, step: shown.append((number, episode, len(step.seen["pixels"])))  # noqa: E731
    (_, shared), (_, alone) = sorted(roll_out([agent, looking], env, [starts] * 2, workers, keep, filmed=[0]))
    assert not (shared.error or alone.error) and len(shared.episodes) == 5
    assert str(shared) == str(alone) and all(map(same_actions, shared.episodes, alone.episodes))
    assert {pictures for number, episode, pictures in shown if number == 0 and episode == 0} == {2}
    assert {pictures for number, episode, pictures in shown if number == 0 and episode > 0} == {0}
    assert {episode for number, episode, _ in shown if number == 0} == {*range(5)}


def test_an_agent_one_of_whose_episodes_fails_has_failed():
    class Falling(Broken):
        cameras = ()

        def reset(self, seed):
            super().reset(seed)
            self.action = None if seed == 1003 else np.zeros(4, dtype=np.float32)

    ((_, outcome),) = roll_out([Falling(None)], ENV, [range(1000, 1005)], n_workers=2)
    assert "lost the plot" in str(outcome.error) and outcome.episodes == []


def test_a_failing_agent_is_recorded_and_the_others_go_on():
    hover = Broken(np.array([0, 0, 0.5, GRIPPER_CLOSED], dtype=np.float32))
    agents = [Broken(None), hover, Broken(np.full(4, np.nan, dtype=np.float32))]
    failed, fine, refused = (
        outcome for _, outcome in sorted(roll_out(agents, ENV, [SEEDS] * len(agents), n_workers=2))
    )
    assert "lost the plot" in str(failed.error) and failed.episodes == []
    assert "finite" in str(refused.error) and refused.episodes == []
    assert fine.error is None
    assert [(e.evaluation_seed, e.steps, e.stage) for e in fine.episodes] == [(s, STEPS, "none") for s in SEEDS]
    assert [e.clipped_steps for e in fine.episodes] == [STEPS] * len(SEEDS), "it asks for 0.5 m a step"
    assert all(0 < e.final_error_m < 1 for e in fine.episodes)
