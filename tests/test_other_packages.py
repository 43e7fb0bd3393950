"""Tasks of other packages: the one that docs/new_task.md prints, installed beside ours and used by its name."""

import logging
import os
import re
import subprocess
import sys
import zipfile
from dataclasses import dataclass, replace
from importlib import import_module, reload
from pathlib import Path
from typing import Any

import pytest
from commands import BIN, call

from lerobot_constructskill import contract, other_tasks
from lerobot_constructskill.demos.node import Demonstrations
from lerobot_constructskill.demos.settings import GenerateConfig, frames_digest
from lerobot_constructskill.envs.gym_env import ConstructSkillEnv
from lerobot_constructskill.errors import InputError

GUIDE = Path(__file__).parents[1] / "docs" / "new_task.md"
FILES = re.compile(r"^```\w+\n# (\S+)\n(.*?)^```$", re.MULTILINE | re.DOTALL)


@pytest.fixture(scope="module")
def installed(tmp_path_factory) -> Path:
    """A folder with the guide's package as an installer leaves it."""
    source, target = tmp_path_factory.mktemp("source"), tmp_path_factory.mktemp("target")
    for name, text in FILES.findall(GUIDE.read_text()):
        (source / name).parent.mkdir(exist_ok=True)
        (source / name).write_text(text)
    build = [sys.executable, "-m", "build", "--wheel", "--no-isolation", "--outdir", source / "dist", source]
    done = subprocess.run(build, capture_output=True, text=True)
    assert done.returncode == 0, done.stdout[-2000:] + done.stderr[-2000:]
    zipfile.ZipFile(next((source / "dist").glob("*.whl"))).extractall(target)
    return target


IN_A_WORKER = """
from lerobot_constructskill.artifacts.pools import open_pool
from lerobot_constructskill.contract import get_task
if __name__ == "__main__":
    with open_pool("processes", 2) as submit:
        print(submit(get_task, "lintel_to_wall").result().env_id)
"""


def test_worker_processes_know_the_guides_task(installed, tmp_path):
    (tmp_path / "main.py").write_text(IN_A_WORKER)
    surroundings = os.environ | {"PYTHONPATH": str(installed)}
    done = subprocess.run([sys.executable, tmp_path / "main.py"], env=surroundings, capture_output=True, text=True)
    assert done.stdout == "LintelToWall-v1\n", done.stderr


@pytest.mark.sim
@pytest.mark.slow
def test_the_guides_task_is_checked_and_recorded_without_a_checkout(installed, tmp_path):
    task, path = "--task=lintel_to_wall", {"PYTHONPATH": str(installed)}
    checked = call(BIN / "constructskill-check-task", task, "--states=1", **path)
    assert "lintel_to_wall: the expert succeeds in 1 of 1 initial states" in checked
    size = ["--episodes=1", "--repo_id=local/lintel", f"--root={tmp_path / 'lintel'}"]
    call(BIN / "constructskill-generate", "smoke", task, *size, **path)
    assert "lintel_to_wall" in (tmp_path / "lintel" / "README.md").read_text()


@dataclass
class Offer:
    """An entry point of a package that is called like it."""

    name: str
    found: Any
    value: str = "rows:ROWS"

    @property
    def dist(self) -> "Offer":
        return self

    def load(self) -> Any:
        if isinstance(self.found, BaseException):
            raise self.found
        return self.found


@pytest.fixture
def install(monkeypatch):
    """Let these packages be installed, each with what its entry point loads, or raises."""

    def install(**found: Any) -> None:
        offers = [Offer(name, of) for name, of in found.items()]
        monkeypatch.setattr(other_tasks, "entry_points", lambda group: offers * (group == other_tasks.GROUP))
        contract._all_tasks.cache_clear()

    yield install
    contract._all_tasks.cache_clear()


def row(name: str, env_id: str = "") -> contract.Task:
    return contract.Task(name, env_id or f"{name}-v1", "Do it.", 100, f"{name}:Scene", f"{name}:Expert")


def test_rows_of_other_packages_come_after_ours(install):
    install(one=row("lay"), two=[row("turn"), row("drill")])
    assert list(contract.TASKS) == [*contract.SHIPPED, "lay", "turn", "drill"]
    assert contract.get_task("drill").horizon == 100
    assert [task.name for task in contract.select_tasks("lay,turn")["constructskill"]] == ["lay", "turn"]
    with pytest.raises(InputError, match="'dril'; the tasks are: brick_to_bin, .*, drill"):
        contract.get_task("dril")


def test_demonstrations_of_an_edited_scene_are_others(install, tmp_path, monkeypatch):
    monkeypatch.syspath_prepend(tmp_path)
    install(one=row("lay"))
    config = GenerateConfig("local/lay", task="lay")
    found = []
    for length in ("0.20", "0.21"):
        (tmp_path / "lay.py").write_text(f"LENGTH = {length}\n")
        found.append((frames_digest(config), Demonstrations(config).digest))
    assert all(before != after for before, after in zip(*found, strict=True))


@pytest.mark.parametrize(
    "field",
    [
        *({"name": name} for name in ("joints", "a,b", "", "../esc")),
        *({"action_names": names} for names in (("gripper", "dx"), ("x", "gripper"), ())),
        *({"horizon": horizon} for horizon in ("ten", 0)),
        *({part: None} for part in ("scene", "expert")),
    ],
    ids=str,
)
def test_a_row_that_nothing_can_be_made_of_is_refused_by_its_field(field):
    (name,) = field
    with pytest.raises(InputError, match=f"cannot have {name} "):
        replace(row("lay"), **field)


@pytest.mark.parametrize("second", [row("lay", "Other-v1"), row("other", "lay-v1"), row("brick_to_bin")])
def test_two_packages_with_one_task_are_refused_by_their_names(install, second):
    install(one=row("lay"), two=second)
    with pytest.raises(InputError, match="packages '(one|lerobot_constructskill)' and 'two' both have a task"):
        contract.get_task("brick_to_bin")


@pytest.mark.parametrize(
    "broken", [ImportError("no module named that\nsecond line"), SystemExit(3), [row("lay"), "lay"], 7]
)
def test_a_package_that_cannot_be_loaded_is_left_out_with_one_sentence(install, caplog, broken):
    install(good=row("turn"), bad=broken)
    with caplog.at_level(logging.WARNING):
        assert list(contract.TASKS) == [*contract.SHIPPED, "turn"]
    (said,) = caplog.messages
    assert said.startswith("The tasks of the package 'bad' are left out: ") and "\n" not in said


@pytest.mark.sim
@pytest.mark.parametrize(
    ("scene", "source", "said"),
    [
        (
            "unfinished",
            "import nothing_like_it",
            r"cannot be imported \(ModuleNotFoundError: No module named ",
        ),
        ("unregistered", "", "does not register lay-v1 with ManiSkill: decorate its class"),
    ],
)
def test_a_scene_that_is_none_stops_its_own_task_alone(scene, source, said, install, tmp_path, monkeypatch):
    (tmp_path / f"{scene}.py").write_text(source)
    monkeypatch.syspath_prepend(tmp_path)
    install(one=replace(row("lay"), scene=f"{scene}:Scene"))
    reload(import_module("lerobot_constructskill.sim.register"))  # as every environment's first step does
    with pytest.raises(InputError, match=f"^The scene of the task 'lay', {scene}:Scene, {said}"):
        ConstructSkillEnv("lay", render_backend="none").reset()
