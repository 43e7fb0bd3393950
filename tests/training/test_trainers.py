"""A training that ends from outside is no result of a policy, and all threads that train flush denormal numbers."""

import os
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from lerobot.datasets import LeRobotDataset
from lerobot.policies.act.configuration_act import ACTConfig

from lerobot_constructskill.artifacts import disk
from lerobot_constructskill.artifacts.failures import is_of_the_machine
from lerobot_constructskill.artifacts.store import Node, Store
from lerobot_constructskill.errors import InputError, MachineError
from lerobot_constructskill.training import trainers
from lerobot_constructskill.training.checkpoints import Checkpoints, check_inputs
from lerobot_constructskill.training.lerobot_train import LOG, _call
from lerobot_constructskill.training.recipe import Training
from lerobot_constructskill.training.trainers import Learner, Trainer

ACT = {"type": "act", "pretrained_backbone_weights": None}


class Written(Node):
    """A LeRobotDataset of a few numbers."""

    kind = "demonstrations"

    def facts(self):
        return {}

    def versions(self):
        return {}

    def make(self, folder, inputs, machine):
        features = {"action": {"dtype": "float32", "shape": (4,), "names": None}}
        dataset = LeRobotDataset.create(f"local/{self.digest}", 20, features, folder, use_videos=False)
        for _ in range(2):
            dataset.add_frame({"action": np.zeros(4, dtype=np.float32), "task": "t"})
            dataset.save_episode()
        dataset.finalize()


def run(code: str, folder: Path) -> None:
    _call([sys.executable, "-c", code], folder / LOG)


@pytest.mark.parametrize("said", ["CUDA out of memory.", "worker (pid 7) is killed by signal: Killed."])
def test_a_training_without_memory_is_the_machines_doing(said, tmp_path):
    with pytest.raises(MachineError, match="ran out of memory"):
        run(f"import sys; sys.exit({said!r})", tmp_path)
    for words, by_machine in (("OSError: [Errno 28] No space left on device", True), ("diverged", False)):
        with pytest.raises(RuntimeError, match="ended with status 1: ") as failed:
            run(f"import sys; sys.exit({words!r})", tmp_path)
        assert words in str(failed.value) and is_of_the_machine(failed.value) is by_machine


@pytest.mark.parametrize("signal", ["SIGKILL", "SIGTERM"])
def test_a_training_that_was_killed_is_the_machines_doing(signal, tmp_path):
    with pytest.raises(MachineError, match=rf"was killed \({signal}\)"):
        run(f"import os, signal; os.kill(os.getpid(), signal.{signal})", tmp_path)


@pytest.mark.parametrize(
    "ending, said", [("print('lost'); exit(3)", "status 3: lost"), ("import os; os.abort()", "status -6")]
)
def test_a_training_that_ends_itself_is_the_policys_doing(ending, said, tmp_path):
    with pytest.raises(RuntimeError, match=said):
        run(ending, tmp_path)


FAILS_UNDER_A_BAR = """
from tqdm import tqdm
bar = tqdm(total=8, desc="Training")
try:
    [][0]
except IndexError as error:
    raise ValueError("of the policy\\nand more") from error
finally:
    print("printed", flush=True)
"""


def test_a_training_that_fails_says_its_exception_and_not_its_progress_bar(tmp_path):
    with pytest.raises(
        RuntimeError, match="(?m)^lerobot-train ended with status 1: ValueError: of the policy$"
    ) as caught:
        run(FAILS_UNDER_A_BAR, tmp_path)
    (note,) = caught.value.__notes__
    assert note == (tmp_path / LOG).read_text() and "Training:   0%|" in note.splitlines()[-1]


def test_what_a_training_prints_is_on_the_disk_while_it_runs(tmp_path):
    run(f"print('begun', flush=True); assert open({str(tmp_path / LOG)!r}).read() == 'begun\\n'", tmp_path)


class Full(Trainer):
    """A trainer whose disk is full. It stands in for the disk: a real one would have to be filled."""

    def fit(self, config, dataset, seeds, training, held_out, folder):
        disk.shutil.disk_usage = lambda path: SimpleNamespace(free=0)
        raise RuntimeError("SafetensorError: os error 28")


@pytest.mark.slow
def test_a_checkpoint_that_finds_no_room_is_the_machines_doing(tmp_path: Path, monkeypatch):
    monkeypatch.setattr(disk.shutil, "disk_usage", disk.shutil.disk_usage)
    monkeypatch.setattr(trainers, "trainer_of", lambda config: Full())
    made = Checkpoints.holding(0, Learner.of(ACT), Training(holdout=2), Written())
    with pytest.raises(MachineError, match="is full"):
        Store(tmp_path).get(made)
    monkeypatch.undo()
    assert not Store(tmp_path).has(made)


ALL_THREADS_FLUSH = """
import os, sys, torch
import lerobot_constructskill.{module} as module

def look(*arguments):
    smallest = torch.full((50_000, 40), 1e-20) @ torch.full((40, 64), 1e-20)
    os._exit(0 if torch.get_num_threads() == 2 and (smallest == 0).all() else 7)

module.{first} = look
from lerobot_constructskill.scripts.{command} import {command}
{command}.main()
"""


@pytest.mark.slow
@pytest.mark.parametrize(
    ("command", "module", "first", "flags"),
    [
        ("study", "study.session", "make_runs", ["smoke", "--root=study"]),
        ("dagger", "dagger.run", "_lines", ["smoke", "--root=dagger", "--repo_id=local/driven"]),
    ],
)
def test_when_work_begins_no_thread_computes_with_denormal_numbers(command, module, first, flags, tmp_path):
    script = ALL_THREADS_FLUSH.format(command=command, module=module, first=first)
    run = [sys.executable, "-c", script, *flags, "--store=store"]
    subprocess.run(run, check=True, cwd=tmp_path, env=os.environ | {"OMP_NUM_THREADS": "2"})


def test_a_policy_of_others_that_names_no_inputs_is_not_taken_to_read_the_state():
    check_inputs(SimpleNamespace(input_features=None), "pixels")
    with pytest.raises(InputError, match="reads observation.state"):
        check_inputs(ACTConfig(), "pixels")


def test_a_policy_that_feels_a_force_is_not_let_into_an_environment_without_it():
    def reads(length):
        return SimpleNamespace(input_features={"observation.state": SimpleNamespace(shape=(length,))})

    for length, obs_type in ((8, "pixels_agent_pos"), (11, "pixels_agent_pos_force"), (6, "pixels_agent_pos")):
        check_inputs(reads(length), obs_type)
    with pytest.raises(InputError, match="reads a state of 11 numbers; .* 'pixels_agent_pos' has 8"):
        check_inputs(reads(11), "pixels_agent_pos")


def test_a_gpus_checkpoint_is_another_and_a_studys_rows_of_a_cpu_are_found_beside_a_gpu(monkeypatch):
    here, there = ACTConfig(device="cpu"), ACTConfig(device="cpu")
    there.device = "cuda:1"  # as on a machine that has one: LeRobot takes the CPU here
    monkeypatch.setattr(trainers, "decode_policy", lambda config: config)
    one, other = Learner.of(here), Learner.of(there)
    assert one.facts()["device"] == "cpu" and other.facts() == one.facts() | {"device": "cuda"}
    assert one.elsewhere == () and [each.facts() for each in other.elsewhere] == [one.facts()]
    assert other.config.device == "cuda:1" and other.acting == {"device": "cuda:1"}


def test_where_a_policy_is_published_and_how_it_is_labelled_is_none_of_its_checkpoints():
    published = ACT | {"push_to_hub": True, "repo_id": "someone/act", "tags": ["x"], "license": "mit"}
    assert Learner.of(published).facts() == Learner.of(ACT).facts()
    assert Learner.of(published).config.repo_id == "someone/act"
