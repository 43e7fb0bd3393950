"""A data set of several tasks, made by the toy: what it says of each, and what every reader makes of it."""

import json
import shutil
from pathlib import Path

import pandas as pd
import pytest
from lerobot.datasets import LeRobotDataset
from toy import record_toy

from lerobot_constructskill.contract import DEMO_SEED_START, SUITES, TASK_NAME, TASKS
from lerobot_constructskill.dataset.card import card_facts, render
from lerobot_constructskill.dataset.checks import CHECKS, complaints
from lerobot_constructskill.dataset.dataset import open_dataset
from lerobot_constructskill.dataset.split import split_of
from lerobot_constructskill.demos.columns import SIDECAR
from lerobot_constructskill.demos.metadata import CONTRACT
from lerobot_constructskill.rollout.references import ReplayAgent
from lerobot_constructskill.training.recipe import held_out_of

NAMES = [task for task in SUITES["bins"] for _ in range(3)]
"""The task of each episode."""


@pytest.fixture(scope="module")
def pristine(tmp_path_factory):
    """Three demonstrations of each of three tasks, of which two have one instruction; one attempt at each fails."""
    root = tmp_path_factory.mktemp("many") / "set"
    record_toy(root, 3, task="bins", action="full")
    return root


@pytest.fixture
def copy(pristine, tmp_path):
    return Path(shutil.copytree(pristine, tmp_path / "set"))


def test_a_set_of_several_tasks_passes_every_check(pristine):
    data = open_dataset(pristine)
    assert {name: complaints(data, check) for name, check in CHECKS.items()} == {name: [] for name in CHECKS}


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


def episodes(change):
    def corrupt(root):
        for path in (root / "meta/episodes").rglob("*.parquet"):
            change(pd.read_parquet(path)).to_parquet(path)

    return corrupt


def rows(change):
    def corrupt(root):
        path = root / "data/chunk-000/file-000.parquet"
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
