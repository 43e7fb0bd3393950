"""The force at the wrist, on request: in environments, in demonstrations, and in the state of a policy."""

import numpy as np
import pytest
from commands import call

from lerobot_constructskill.contract import FORCE_NAMES, STATE_NAMES, get_task
from lerobot_constructskill.dataset.checks import CHECKS, complaints
from lerobot_constructskill.dataset.dataset import open_dataset
from lerobot_constructskill.demos.expert import ExpertConfig, PrivilegedState, make_expert
from lerobot_constructskill.demos.recorder import GenerateConfig, record
from lerobot_constructskill.envs.gym_env import ConstructSkillEnv
from lerobot_constructskill.envs.vector_env import NativeVectorEnv
from lerobot_constructskill.scripts.dataset import replay_episode

pytestmark = pytest.mark.sim

TASK, FORCE = "brick_to_bin", "pixels_agent_pos_force"


@pytest.fixture(scope="module")
def lifted():
    """Actions until the brick hangs over the bin, and the states, shown and privileged, before and after each."""
    env, expert = ConstructSkillEnv(TASK, FORCE, render_backend="none"), make_expert(get_task(TASK), ExpertConfig())
    seen, _ = env.reset(seed=1)
    sim, actions = [PrivilegedState(**env.privileged_state())], []
    states, progress = [seen["agent_pos"]], expert.start(sim[0])
    while np.linalg.norm((sim[-1].object_pose[:3] - sim[-1].bin_position)[:2]) > 0.1:
        action, _, progress = expert.act(sim[-1], progress)
        seen, *_ = env.step(action)
        actions.append(action)
        states.append(seen["agent_pos"])
        sim.append(PrivilegedState(**env.privileged_state()))
    env.close()
    return actions, np.array(states), sim


def test_it_is_the_weight_of_what_is_held_and_next_to_nothing_before(lifted):
    _, states, sim = lifted
    force, weight = states[:, len(STATE_NAMES) :], 9.81 * sim[-1].object_mass[0]
    assert states.dtype == np.float32 and force.shape[1] == len(FORCE_NAMES) and not force[0].any()
    touched = next(number for number, one in enumerate(sim) if one.finger_forces.any())
    assert touched > 20 and np.linalg.norm(force[:touched], axis=1).max() < 2
    assert force[-10:, 2].mean() == pytest.approx(-weight, rel=0.15)


def test_without_it_the_state_is_as_it_was_and_vector_environments_show_the_same(lifted):
    actions, states, _ = lifted
    plain = ConstructSkillEnv(TASK, "pixels_agent_pos", render_backend="none")
    native = NativeVectorEnv(1, task=TASK, obs_type=FORCE, render_backend="none")
    seen = [(plain.reset(seed=1)[0], native.reset(seed=[1])[0])]
    seen += [(plain.step(action)[0], native.step(action[None])[0]) for action in actions]
    np.testing.assert_array_equal([one["agent_pos"] for one, _ in seen], states[:, : len(STATE_NAMES)])
    np.testing.assert_array_equal([one["agent_pos"][0] for _, one in seen], states)
    plain.close()
    native.close()


@pytest.mark.slow
def test_demonstrations_record_it_and_lerobots_scripts_carry_it_to_a_policy(tmp_path):
    root, out = tmp_path / "set", tmp_path / "act"
    record(GenerateConfig("local/force", str(root), episodes=1, obs_type=FORCE, cameras=["wrist"]))
    data = open_dataset(root)
    assert data.info["features"]["observation.state"]["names"] == [*STATE_NAMES, *FORCE_NAMES]
    assert data.column("observation.state")[:, -1].min() < -10 and replay_episode(data, 0) == (True, 0.0)
    assert {name: complaints(data, check) for name, check in CHECKS.items()} == {name: [] for name in CHECKS}
    small = ["pretrained_backbone_weights=null", "dim_model=64", "n_heads=2", "dim_feedforward=64", "device=cpu"]
    call(
        *("lerobot-train", "--dataset.repo_id=local/force", f"--dataset.root={root}", f"--output_dir={out}"),
        *("--policy.type=act", "--policy.push_to_hub=false", *(f"--policy.{one}" for one in small)),
        *("--steps=1", "--batch_size=2", "--num_workers=0", "--env_eval_freq=0"),
    )
    call(
        *("lerobot-eval", f"--policy.path={out}/checkpoints/last/pretrained_model", "--policy.device=cpu"),
        *("--env.type=constructskill", f"--env.obs_type={FORCE}", "--env.episode_length=3"),
        *("--eval.n_episodes=1", "--eval.batch_size=1", f"--output_dir={tmp_path / 'eval'}"),
    )
