"""DAgger from a base of several tasks: a policy that is told the instruction drives each of them.

The simulator is the toy of the data sets' tests; the policy, the experts, the store and the merging are the real ones.
"""

import json
import shutil
from collections import Counter

import numpy as np
import pytest
from lerobot.datasets import LeRobotDataset
from toy_simulators import ToyEnv, toy_simulators

from lerobot_constructskill.artifacts.store import Store
from lerobot_constructskill.contract import TASK_NAME, TASKS
from lerobot_constructskill.dagger import driving, rounds
from lerobot_constructskill.dagger.plan import Plan
from lerobot_constructskill.dagger.rounds import Round
from lerobot_constructskill.dagger.run import run_dagger
from lerobot_constructskill.dagger.settings import ROUND_SEED_START, DaggerConfig
from lerobot_constructskill.dataset.card import card_facts, render
from lerobot_constructskill.dataset.checks import CHECKS, complaints
from lerobot_constructskill.dataset.dataset import open_dataset
from lerobot_constructskill.demos import shards
from lerobot_constructskill.demos.columns import SIDECAR
from lerobot_constructskill.demos.language import SUBTASKS
from lerobot_constructskill.policies.frozen_vit import openvino
from lerobot_constructskill.rollout.agents import PolicyAgent
from lerobot_constructskill.training.recipe import Training, held_out_of

pytestmark = pytest.mark.slow

BRICK, BLOCK = "brick_to_bin", "block_to_bin"
NAMES = 3 * [BRICK, BRICK, BLOCK, BLOCK]
"""The task of each episode: of the demonstrations, then of two rounds."""

BRISK = "--expert.max_step=0.05 --expert.load_max_step=0.06 --expert.grasp_dwell=3"
"""An expert whose demonstrations have few frames to encode."""


@pytest.fixture(scope="module", autouse=True)
def toys():
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(driving, "simulators", toy_simulators)
        patch.setattr(shards, "_environment", ToyEnv)
        patch.setattr(openvino, "is_installed", lambda: False)
        yield


@pytest.fixture(scope="module")
def config(tiny_weights):
    """Two demonstrations of each task, two rounds of two short episodes, a policy that is told the task by number."""
    policy = {"type": "frozen_vit", "backbone": "vit_tiny16", "backbone_path": str(tiny_weights)}
    return DaggerConfig(
        "local/driven",
        policy | {"readout": "cls", "language": "number", "backbone_precision": "float32"},
        base=f"smoke --task={BRICK},{BLOCK} --action=full --annotate=true {BRISK}",
        training=Training(epochs=1, batch_size=64, holdout=2),
        rounds=2,
        episodes=2,
        betas=[0.5, 0.0],
        max_steps=15,
        workers=1,
    )


@pytest.fixture(scope="module")
def made(config, tmp_path_factory):
    """The folder of the run and its lines; the store beside it."""
    root = tmp_path_factory.mktemp("several") / "run"
    return root, run_dagger(config, Store(root.with_name("store")), root)


@pytest.fixture(scope="module")
def dataset(made):
    return LeRobotDataset("local/driven", root=made[0] / "dataset")


def test_every_task_is_driven_in_every_round_from_the_same_starts(dataset):
    episodes = dataset.meta.episodes
    assert episodes[TASK_NAME] == NAMES and dataset.meta.total_tasks == 2
    firsts = [dataset[episode["dataset_from_index"]] for episode in episodes]
    assert [frame["task"] for frame in firsts] == [TASKS[name].instruction for name in NAMES]
    assert [int(frame["dagger.round"]) for frame in firsts] == [0] * 4 + [1] * 4 + [2] * 4
    assert [int(frame["sim.seed"]) - ROUND_SEED_START for frame in firsts[4:]] == [0, 1, 0, 1, 2, 3, 2, 3]
    assert firsts[-1]["action"].shape == (7,) and firsts[-1]["dagger.actor"] == "learner"


def test_every_nth_of_each_task_is_held_out(dataset):
    assert held_out_of(dataset, 2) == [1, 3, 5, 7, 9, 11]
    assert held_out_of(dataset, 4) == [5, 7], "the fourth of each task: they are not counted together"


def test_the_lines_tell_of_each_task(made):
    root, lines = made
    assert json.loads((root / "rounds.json").read_text()) == [vars(line) for line in lines]
    drove = lines[0].drove
    assert drove["episodes"] == 4 and [*drove["tasks"]] == [BRICK, BLOCK]
    assert drove["frames"] == sum(one["frames"] for one in drove["tasks"].values()) == 60
    assert f"placed 0 of 4 ({BRICK} 0, {BLOCK} 0), 60 frames" in str(lines[0])
    assert lines[2].frames == lines[0].frames + 120 and lines[2].drove is None


def test_the_set_passes_every_check_and_its_card_tells_of_each_task(made):
    data = open_dataset(made[0] / "dataset")
    assert {name: complaints(data, check) for name, check in CHECKS.items()} == {name: [] for name in CHECKS}
    card = render(card_facts(data) | {"repo_id": "local/driven"})
    assert f"| 1 | {BRICK} |" in card and f"| 2 | {BLOCK} |" in card


@pytest.mark.parametrize(
    ("field", "value", "check", "said"),
    [
        ("frames", 1, "Provenance", "Round 1 of brick_to_bin has 30 frames"),
        ("seed_start", 2_000_001, "Provenance", "do not count up from 2000001"),
        ("task", BLOCK, "Episodes", "must have task_name"),
        ("task", None, "Schema", "does not say in dagger"),
    ],
)
def test_the_checks_see_what_is_wrongly_said_of_a_round(made, field, value, check, said):
    data = open_dataset(made[0] / "dataset")
    data.facts["dagger"]["rounds"][0][field] = value
    assert said in " ".join(complaints(data, CHECKS[check]))


def test_the_subtask_of_a_frame_is_the_experts_phase_also_where_a_policy_fails(dataset):
    from lerobot.datasets.language_render import active_at

    things = {BRICK: "brick", BLOCK: "concrete block"}
    for number in (4, 10):
        episode = dataset.meta.episodes[number]
        for index in range(episode["dataset_from_index"], episode["dataset_to_index"]):
            frame = dataset[index]
            assert not frame["next.success"]
            held = active_at(float(frame["timestamp"]), persistent=frame["language_persistent"], style="subtask")
            assert held["content"] == SUBTASKS[frame["phase"]].format(things[NAMES[number]])


def test_a_killed_round_of_a_task_goes_on_with_its_whole_episodes_and_is_told_its_sentence(
    made, config, tmp_path, monkeypatch
):
    plan = Plan.of(config)
    store = Store(shutil.copytree(made[0].with_name("store"), tmp_path / "store", symlinks=True))
    other, one = plan.round(1)
    folder, asked, told, drive, see = store.folder(one), [], Counter(), Round._drive, PolicyAgent.see
    before = frames_of(folder)
    shutil.rmtree(folder)

    def stop(*_):
        raise MemoryError

    def note(self, checkpoint, seeds, machine):
        asked.append((self.task.name, list(seeds)))
        return drive(self, checkpoint, seeds, machine)

    def listen(self, observation):
        told[observation.instruction] += 1
        return see(self, observation)

    monkeypatch.setattr(Round, "_drive", note)
    monkeypatch.setattr(PolicyAgent, "see", listen)
    with monkeypatch.context() as patch, pytest.raises(MemoryError):
        patch.setattr(rounds, "aggregate", stop)
        store.get(one)
    first, second = plan.seeds(1)
    next(tmp_path.rglob(f"{second}/outcome.json")).write_text("")  # as a power cut may leave it
    store.get(one)
    assert asked == [(BLOCK, [first, second]), (BLOCK, [second])] and store.has(other)
    assert told == {TASKS[BLOCK].instruction: 45}
    for name, values in frames_of(folder).items():
        np.testing.assert_array_equal(values, before[name])


def frames_of(root):
    rows = LeRobotDataset("local/round", root=root).hf_dataset.with_format("numpy")
    return {name: rows[name][:] for name in ("action", "dart.executed_action", "phase", "sim.seed", "task_index")}


def test_the_record_lists_each_round_of_each_task(made):
    facts = json.loads((made[0] / "dataset" / SIDECAR).read_text())
    assert [*facts["tasks"]] == [BRICK, BLOCK] and facts["dagger"]["demonstrations"] == 4
    listed = [(one["round"], one["task"], one["episodes"], one["seed_start"]) for one in facts["dagger"]["rounds"]]
    assert listed == [(1 + k // 2, (BRICK, BLOCK)[k % 2], 2, ROUND_SEED_START + k // 2 * 2) for k in range(4)]
