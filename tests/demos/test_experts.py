"""Experts and noise: pure functions, checked as such, and experts that must succeed on the real simulator."""

from dataclasses import fields, replace
from itertools import chain, islice
from math import ceil
from pathlib import Path

import draccus
import numpy as np
import pytest
from kinds import KINDS

from lerobot_constructskill.contract import DEMO_SEED_START, GRIPPER_OPEN, ROBOT_BASE, SIM_STATE, TASKS
from lerobot_constructskill.demos.demonstrate import demonstrate
from lerobot_constructskill.demos.expert import ExpertConfig, ExpertProgress, Phase, PrivilegedState, make_expert
from lerobot_constructskill.demos.laying import LayingExpert
from lerobot_constructskill.demos.noise import NoiseConfig, execute
from lerobot_constructskill.demos.recorder import GenerateConfig
from lerobot_constructskill.envs.gym_env import ConstructSkillEnv
from lerobot_constructskill.plans.check import FARTHEST, NEAREST
from lerobot_constructskill.plans.plan import SUPPLIES

CONFIGS = Path(__file__).parents[2] / "configs" / "generate"
NO_NOISE = NoiseConfig(sigma=0.0)
PAPER_END = [-0.03045, -0.37334, 0.11969]
"""Where the brick is in the last frame of the first noisy demonstration, in metres."""


def state(**changes):
    defaults = {
        "tcp_pose": [0.0, 0.0, 0.17, 0, 1, 0, 0],
        "fingers": [0.04, 0.04],
        "object_pose": [0.0, 0.0, 0.05, 1, 0, 0, 0],
        "object_size": [0.21, 0.065, 0.10],
        "object_mass": [1.365],
        "bin_position": [0.0, -0.35, 0.08],
        "bin_interior": [0.25, 0.20, 0.15],
    }
    return PrivilegedState(**{name: np.array(value, float) for name, value in (defaults | changes).items()})


@pytest.fixture(scope="module", params=KINDS)
def env(request):
    env = ConstructSkillEnv(request.param, render_backend="none")
    yield env
    env.close()


def test_the_experts_state_is_the_contracts():
    assert {field.name for field in fields(PrivilegedState)} == set(SIM_STATE)


@pytest.mark.parametrize("task", TASKS)
def test_an_expert_is_a_pure_function(task):
    expert, s = make_expert(TASKS[task], ExpertConfig()), state()
    progress = expert.start(s)
    first, second = expert.act(s, progress), expert.act(s, progress)
    np.testing.assert_array_equal(first[0], second[0])
    assert first[1:2] == second[1:2] and progress.steps == 0
    assert len(first[0]) == len(TASKS[task].action_names)


def test_the_expert_stays_above_an_object_it_is_not_over():
    expert = make_expert(TASKS["brick_to_bin"], ExpertConfig())
    progress = expert.start(state())
    over = state(tcp_pose=[0, 0.001, 0.12, 0, 1, 0, 0])
    beside = state(tcp_pose=[0, 0.012, 0.115, 0, 1, 0, 0])
    while progress.phase is not Phase.DESCEND:
        *_, progress = expert.act(state(tcp_pose=[0, 0, 0.22, 0, 1, 0, 0]), progress)
    assert expert.act(over, progress)[0][2] < 0
    assert expert.act(beside, progress)[0][2] > 0 and expert.act(beside, progress)[0][1] < 0


def test_what_little_play_is_left_narrows_as_the_object_comes_down():
    """The expert lowers inside a funnel: far off the middle high above the opening, hardly at all at its rim."""
    expert = make_expert(TASKS["brick_to_bin_10mm"], ExpertConfig())
    middle = {"bin_position": [0.0, -0.35, 0.025], "bin_interior": [0.22, 0.075, 0.04]}

    def lowered(off: float, gap: float) -> bool:
        held = [off, -0.35, 0.045 + gap + 0.05]
        at = state(object_pose=[*held, 1, 0, 0, 0], tcp_pose=[*held, 0, 1, 0, 0], fingers=[0.0325] * 2, **middle)
        return expert._haste(at, expert._carry_error(at)) == 1.0

    assert lowered(0.003, gap=0.04) and not lowered(0.003, gap=0.0) and lowered(0.001, gap=0.0)
    assert not lowered(0.02, gap=0.04)
    assert not lowered(0.003, gap=-0.001), "what the rim has pushed aside rises and comes again"
    assert lowered(0.003, gap=-0.004), "in the opening there is no way but down"


@pytest.mark.parametrize("x, height", [(0.0, 0.40), (0.10, 0.25)])
def test_the_lift_is_the_papers_or_as_high_as_the_arm_reaches(x, height):
    expert = make_expert(TASKS["brick_to_bin"], ExpertConfig())
    held = state(tcp_pose=[x, 0, 0.08, 0, 1, 0, 0])
    target = expert._target(held, ExpertProgress(Phase.LIFT, 0, held.tcp))
    np.testing.assert_allclose(target - held.tcp, [0, 0, height], atol=0.01)


@pytest.mark.parametrize(
    "mass, up", [(1.3649998, "0x1.8c6a8cp-5"), (1.3650001, "0x1.8c6a8ep-5"), (1.3650012, "0x1.8c6a94p-5")]
)
def test_the_paper_tasks_lift_is_rounded_as_in_the_data_sets_that_exist(mass, up):
    """Each value is the first release's; another order of the same multiplication gives another last bit."""
    held = state(tcp_pose=[0, 0, 0.17, 0, 1, 0, 0])
    held = replace(held, tcp_pose=held.tcp_pose.astype(np.float32), object_mass=np.array([mass], np.float32))
    action, *_ = make_expert(TASKS["brick_to_bin"], ExpertConfig()).act(held, ExpertProgress(Phase.LIFT, 0, held.tcp))
    assert action[2] == float.fromhex(up)


@pytest.mark.parametrize(
    "bad", [{"gain": float("nan")}, {"gain": 0}, {"max_step": -1}, {"threshold": 0}, {"grasp_dwell": 0}]
)
def test_impossible_experts_are_refused(bad):
    with pytest.raises(ValueError, match=next(iter(bad))):
        ExpertConfig(**bad)


@pytest.mark.parametrize("phase", Phase)
def test_noise_is_gaussian_where_it_is_on_and_absent_elsewhere(phase):
    rng, clean = np.random.default_rng(0), np.array([0.0, 0.01, -0.02, GRIPPER_OPEN], dtype=np.float32)
    noise = np.array([execute(clean, phase, NoiseConfig(), rng) - clean for _ in range(4000)])
    assert (noise[:, 3] == 0).all()
    if phase in (Phase.GRASP, Phase.RELEASE):
        assert (noise == 0).all()
    else:
        np.testing.assert_allclose(noise[:, :3].mean(axis=0), 0, atol=6e-4)
        np.testing.assert_allclose(noise[:, :3].std(axis=0), 0.01, rtol=0.05)


def test_the_executed_translation_is_clipped_and_the_label_is_not_touched():
    clean = np.array([0.075, -0.075, 0.0, -1.0], dtype=np.float32)
    rng = np.random.default_rng(0)
    executed = np.array([execute(clean, Phase.LIFT, NoiseConfig(), rng) for _ in range(500)])
    assert np.abs(executed[:, :3]).max() == np.float32(0.08)
    np.testing.assert_array_equal(clean, np.array([0.075, -0.075, 0.0, -1.0], dtype=np.float32))


@pytest.mark.sim
def test_every_expert_succeeds_without_noise_through_all_phases_in_order(env):
    expert = make_expert(TASKS[env.task], ExpertConfig())
    for seed in range(DEMO_SEED_START, DEMO_SEED_START + 3):
        frames, success = demonstrate(env, expert, NO_NOISE, seed)
        assert success and frames[-1]["next.reward"] == 1.0
        assert list(dict.fromkeys(frame["phase"] for frame in frames)) == list(Phase)


@pytest.mark.sim
def test_every_expert_succeeds_in_as_many_of_ten_noisy_attempts_as_its_row_says(env):
    expert, enough = make_expert(TASKS[env.task], ExpertConfig()), ceil(10 * TASKS[env.task].noisy_yield)
    outcomes = (demonstrate(env, expert, NoiseConfig(), DEMO_SEED_START + i)[1] for i in range(10))
    assert len(list(islice(filter(None, outcomes), enough))) == enough, "the rest of the ten is not tried"


@pytest.mark.sim
def test_the_papers_demonstration_is_the_one_it_always_was():
    """Data sets replay, and compare, only while physics, expert and noise are what they were (CPU physics)."""
    env = ConstructSkillEnv("brick_to_bin", render_backend="none")
    frames, success = demonstrate(
        env, make_expert(TASKS["brick_to_bin"], ExpertConfig()), NoiseConfig(), DEMO_SEED_START
    )
    env.close()
    assert success and len(frames) == 110
    np.testing.assert_allclose(frames[-1]["sim.object_pose"][:3], PAPER_END, atol=1e-4)


@pytest.mark.sim
@pytest.mark.parametrize("name, frames", [("paper", 462), ("paper_noise_free", 430)])
def test_the_papers_set_is_as_long_as_the_paper_says(name, frames):
    config = draccus.parse(GenerateConfig, CONFIGS / f"{name}.yaml", args=["--repo_id=local/paper"])
    env = ConstructSkillEnv(config.task, config.obs_type, config.max_steps, render_backend="none")
    attempt, success = demonstrate(
        env, make_expert(TASKS[config.task], config.expert), config.noise, config.seed_start
    )
    env.close()
    assert success and len(attempt) == pytest.approx(frames, rel=0.25)


@pytest.mark.sim
def test_a_demonstration_goes_on_to_the_experts_end_where_it_is_asked_to():
    """The set `direct`: all of RELEASE is there, no path rises before the grasp, and success is said to the end."""
    config = draccus.parse(GenerateConfig, CONFIGS / "direct.yaml", args=["--repo_id=local/direct"])
    env = ConstructSkillEnv(config.task, render_backend="none")
    expert = make_expert(TASKS[config.task], config.expert)
    whole, success = demonstrate(env, expert, NO_NOISE, config.seed_start, stop_at_success=config.stop_at_success)
    placed, _ = demonstrate(env, expert, NO_NOISE, config.seed_start)
    env.close()
    assert success and sum(frame["phase"] == "RELEASE" for frame in whole) == config.expert.release_dwell
    assert len(placed) < len(whole) and placed[-1]["next.done"] and not whole[len(placed) - 1]["next.done"]
    assert whole[-1]["next.done"] and all(frame["next.success"] for frame in whole[len(placed) - 1 :])
    heights = [frame["sim.tcp_pose"][2] for frame in whole if frame["phase"] in ("PREGRASP", "DESCEND")]
    assert np.diff(heights).max() < 0.002


@pytest.mark.sim
def test_the_load_compensation_holds_the_brick_where_the_arm_alone_sags():
    """What `ExpertConfig.compliance` is for: a held brick sinks by centimetres a second where nothing is added."""
    env = ConstructSkillEnv("brick_to_bin", episode_length=300, render_backend="none")
    expert = make_expert(TASKS["brick_to_bin"], ExpertConfig())

    def drift(upward):
        """Metres that a lifted brick moves in 20 steps of a constant `upward` translation."""
        env.reset(seed=0)
        sim = PrivilegedState(**env.privileged_state())
        progress = expert.start(sim)
        while progress.phase is not Phase.CARRY:
            action, _, progress = expert.act(sim, progress)
            env.step(action)
            sim = PrivilegedState(**env.privileged_state())
        start = sim.tcp[2]
        for _ in range(20):
            env.step(np.array([0, 0, upward, -1], dtype=np.float32))
        return env.privileged_state()["tcp_pose"][2] - start

    weight = 9.81 * 1.365
    compensated, alone = drift(ExpertConfig().compliance * weight), drift(0.0)
    env.close()
    assert alone < -0.03 and 0 < compensated < -alone


@pytest.mark.slow
def test_the_hand_goes_round_the_base_to_every_place_where_elements_wait():
    """Where it goes by the actions alone, 40 % of what they ask for; within 0.22 m of the base it gets stuck."""
    expert, base = LayingExpert(ExpertConfig()), np.array(ROBOT_BASE)
    goals = [(x, y) for x in np.arange(-0.6, 0.1, 0.1) for y in np.arange(-0.6, -0.1, 0.1)]
    goals = [goal for goal in goals if NEAREST <= np.hypot(*(goal - base[:2])) <= FARTHEST]
    for start, end in chain(*(((place, goal), (goal, place)) for place in SUPPLIES for goal in goals)):
        hand, target = np.array([*start, 0.4]), np.array([*end, 0.4])
        for _ in range(400):
            way = expert._way(target - hand, state(tcp_pose=[*hand, 0, 1, 0, 0]))
            hand = hand + 0.4 * np.clip(way, -0.03, 0.03)
            assert np.hypot(*(hand - base)[:2]) > 0.22, (start, end)
        assert np.linalg.norm(target - hand) < 0.02, (start, end)
