"""A data set of several tasks, made by the toy: what it says of each, and what every reader makes of it."""

import json

import numpy as np
import pandas as pd
import pytest
from commands import call
from lerobot.datasets import LeRobotDataset
from torch.utils.data import DataLoader
from toy import record_toy, rows

from lerobot_constructskill.contract import DEMO_SEED_START, SHIPPED, SUITES, TASK_NAME, TASKS
from lerobot_constructskill.dataset.card import card_facts, render
from lerobot_constructskill.dataset.checks import CHECKS, complaints
from lerobot_constructskill.dataset.dataset import open_dataset
from lerobot_constructskill.dataset.split import split_of
from lerobot_constructskill.demos.columns import SIDECAR
from lerobot_constructskill.demos.language import SUBTASKS, objects_of, persistent_rows
from lerobot_constructskill.demos.metadata import CONTRACT
from lerobot_constructskill.demos.settings import GenerateConfig
from lerobot_constructskill.features.encode import _write_copy
from lerobot_constructskill.lerobot_internals import LAST_CHECKPOINT, lerobot_collate_fn
from lerobot_constructskill.parsing import parse
from lerobot_constructskill.policies.frozen_vit.feature_sets import feature_key
from lerobot_constructskill.rollout.agents import PolicyAgent
from lerobot_constructskill.rollout.references import ReplayAgent
from lerobot_constructskill.training.recipe import held_out_of

pytestmark = pytest.mark.slow

NAMES = [task for task in SUITES["bins"] for _ in range(3)]
"""The task of each episode."""


@pytest.fixture(scope="module")
def pristine(tmp_path_factory):
    """Three demonstrations of each of three tasks, of which two have one instruction; one attempt at each fails."""
    root = tmp_path_factory.mktemp("many") / "set"
    record_toy(root, 3, task="bins", action="full", annotate=True)
    return root


def test_a_set_of_several_tasks_passes_every_check(pristine):
    data = open_dataset(pristine)
    assert {name: complaints(data, check) for name, check in CHECKS.items()} == {name: [] for name in CHECKS}


@pytest.mark.parametrize("is_another_bin", [False, True])
def test_another_task_may_have_the_same_actions_for_another_bin(copy, is_another_bin):
    path = copy / "data/chunk-000/file-000.parquet"
    table = pd.read_parquet(path)
    again = table[table["episode_index"] == 0].assign(episode_index=3)
    if is_another_bin:
        again["sim.bin_interior"] = [interior + np.float32(0.01) for interior in again["sim.bin_interior"]]
    before, after = (table[table["episode_index"] < 3], table[table["episode_index"] > 3])
    pd.concat([before, again, after], ignore_index=True).to_parquet(path)
    found = complaints(open_dataset(copy), CHECKS["Duplicates"])
    assert found == ([] if is_another_bin else ["Episode 3 repeats episode 0."])


def test_lerobot_reads_the_instruction_of_each_task_and_we_the_name(pristine):
    dataset = LeRobotDataset("local/toy", root=pristine)
    assert dataset.meta.episodes[TASK_NAME] == NAMES
    firsts = [dataset[episode["dataset_from_index"]] for episode in dataset.meta.episodes]
    assert [frame["task"] for frame in firsts] == [TASKS[name].instruction for name in NAMES]
    assert dataset.meta.total_tasks == 2 and firsts[0]["action"].shape == (7,)
    seeds = [DEMO_SEED_START + number for number in (0, 1, 3)]
    assert [int(frame["sim.seed"]) for frame in firsts] == seeds * 3


def test_every_nth_of_each_task_is_held_out(pristine):
    dataset = LeRobotDataset("local/toy", root=pristine)
    assert held_out_of(dataset, 2) == [1, 4, 7] and held_out_of(dataset) == []
    assert split_of(pristine).episodes == list(range(9))


def test_a_replay_executes_a_demonstration_of_its_own_task(pristine):
    dataset = LeRobotDataset("local/toy", root=pristine)
    executed = dataset.hf_dataset.with_format("numpy")["dart.executed_action"][:]
    row = dataset.meta.episodes[7]
    agent = ReplayAgent(TASKS["block_to_bin"], dataset, 1)
    assert (agent.actions == executed[row["dataset_from_index"] : row["dataset_to_index"]]).all()


def test_the_card_and_the_contract_name_every_task(pristine):
    card = render(card_facts(open_dataset(pristine)))
    for name in SUITES["bins"]:
        assert f"| {name} | `{TASKS[name].env_id}` | {TASKS[name].instruction} | 3 | 4 |" in card
        assert f"Discarded of {name}: seeds {DEMO_SEED_START + 2}." in card
    assert f"--env.task={','.join(SUITES['bins'])} --env.action=full" in card and "one task" not in card
    said = json.loads((pristine / CONTRACT).read_text())
    assert [task["task"] for task in said["tasks"]] == [*SUITES["bins"]] and len(said["action"]["channels"]) == 7


def test_lerobot_reads_the_subtask_of_each_frame_and_other_words_for_the_task(pristine):
    """By its own resolver: the active subtask is that of the frame's phase, from the phase's first frame on."""
    from lerobot.datasets.language_render import active_at

    dataset = LeRobotDataset("local/toy", root=pristine)
    assert dataset.meta.has_language_columns
    block = dataset.meta.episodes[6]
    for index in range(block["dataset_from_index"], block["dataset_to_index"]):
        frame = dataset[index]
        held = active_at(float(frame["timestamp"]), persistent=frame["language_persistent"], style="subtask")
        assert held["content"] == SUBTASKS[frame["phase"]].format("concrete block") and frame["language_events"] == []
    words = [row["content"] for row in frame["language_persistent"] if row["style"] == "task_aug"]
    assert words == [frame["task"], *TASKS["block_to_bin"].rewordings[0]]
    batch = next(iter(DataLoader(dataset, 4, collate_fn=lerobot_collate_fn)))
    assert batch["action"].shape == (4, 7)


@pytest.mark.parametrize("task", SHIPPED)
def test_every_task_names_its_objects(task):
    assert "object" not in objects_of(TASKS[task]) and len({*objects_of(TASKS[task])}) == len(objects_of(TASKS[task]))


def test_a_subtask_of_a_wall_names_the_element_that_the_expert_has_in_hand():
    phases = np.array([*(["PREGRASP"] * 2), "GRASP", *(["RELEASE"] * 2), *(["PREGRASP"] * 2)])
    rows = persistent_rows(TASKS["lintel_on_posts"], phases, np.array([0, 0, 0, 0, 1, 1, 1]), np.arange(7) / 20)
    assert [(row["content"], round(20 * row["timestamp"])) for row in rows if row["style"] == "subtask"] == [
        ("Move the open gripper above the post 1.", 0),
        ("Close the gripper on the post 1.", 2),
        ("Set the post 1 down and let go.", 3),
        ("Move the open gripper above the post 2.", 5),
    ]


def test_a_feature_set_says_of_which_task_its_episodes_are(pristine, tmp_path):
    dataset = LeRobotDataset("local/toy", root=pristine)
    column = np.zeros((dataset.num_frames, 2), np.float32)
    _write_copy(dataset, "base", {feature_key("base"): column}, [], {}, "local/features", tmp_path / "set")
    assert held_out_of(LeRobotDataset("local/features", root=tmp_path / "set"), 2) == [1, 4, 7]


def test_stock_act_trains_on_it_and_its_errors_are_measured_in_seven_numbers(pristine, tmp_path):
    small = ["dim_model=32", "n_heads=2", "dim_feedforward=32", "n_encoder_layers=1", "latent_dim=8", "chunk_size=10"]
    flags = [*small, "n_action_steps=10", "pretrained_backbone_weights=null", "push_to_hub=false", "device=cpu"]
    call(
        "lerobot-train",
        f"--dataset.root={pristine}",
        "--dataset.repo_id=local/toy",
        *("--policy.type=act", *(f"--policy.{flag}" for flag in flags)),
        *("--steps=2", "--save_freq=2", "--batch_size=2", "--num_workers=0", f"--output_dir={tmp_path / 'act'}"),
    )
    checkpoint = tmp_path / "act" / LAST_CHECKPOINT
    assert PolicyAgent.from_pretrained(checkpoint).action == "full"
    sources = [f"--root={pristine}", "--repo_id=local/toy", "--episodes=[8]"]
    call("constructskill-offline", *sources, f"--policies=['{checkpoint}']", f"--out={tmp_path / 'offline'}")
    (row,) = json.loads((tmp_path / "offline" / "offline.json").read_text())
    assert row["rmse_rotation_rad"] is not None and row["episodes"] == "8"
    call("constructskill-fit-noise", *sources, f"--policy_path={checkpoint}", f"--out={tmp_path / 'dart.yaml'}")
    fitted = parse(GenerateConfig, ["--repo_id=local/dart"], tmp_path / "dart.yaml")
    assert (fitted.task, fitted.action) == (",".join(SUITES["bins"]), "full")


def episodes(change):
    def corrupt(root):
        for path in (root / "meta/episodes").rglob("*.parquet"):
            change(pd.read_parquet(path)).to_parquet(path)

    return corrupt


def said(change):
    def corrupt(root):
        change(pd.read_parquet(root / "meta/tasks.parquet")).to_parquet(root / "meta/tasks.parquet")

    return corrupt


def made(change):
    def corrupt(root):
        facts = json.loads((root / SIDECAR).read_text())
        change(facts)
        (root / SIDECAR).write_text(json.dumps(facts))

    return corrupt


DAMAGES = {
    "another name": (episodes(lambda table: table.assign(task_name=NAMES[::-1])), "Episodes", "must have task_name"),
    "no names": (episodes(lambda table: table.drop(columns=TASK_NAME)), "Episodes", "must have task_name"),
    "another instruction": (
        rows(lambda table: table.assign(task_index=table["task_index"].where(table["index"] != 5, 1))),
        "Episodes",
        "another instruction than the episode's in 1 frame",
    ),
    "another subtask": (
        rows(
            lambda table: table.assign(
                phase=table["phase"].where(table["frame_index"] != (table["phase"] == "LIFT").argmax(), "GRASP")
            )
        ),
        "Language",
        "not what the phases say",
    ),
    "no attempts": (made(lambda facts: facts.pop("tasks")), "Provenance", "does not say in tasks"),
    "other attempts": (
        made(lambda facts: facts["tasks"]["block_to_bin"].update(attempts=5)),
        "Provenance",
        "episodes of block_to_bin and the discarded ones",
    ),
    "other tasks": (made(lambda facts: facts["generator"].update(task="joints")), "Schema", "does not say in tasks"),
    "other words": (said(lambda table: table.rename({TASKS["block_to_bin"].instruction: "Go."})), "Schema", "'Go.'"),
}


@pytest.mark.parametrize(("corrupt", "check", "words"), DAMAGES.values(), ids=DAMAGES)
def test_what_is_said_of_the_tasks_is_checked(corrupt, check, words, copy):
    corrupt(copy)
    found = complaints(open_dataset(copy), CHECKS[check])
    assert found and words in " ".join(found)
