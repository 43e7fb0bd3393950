"""What others' code is: told by its source, wherever Python finds it, and by nothing beside it."""

from pathlib import Path

import pytest
from lerobot.policies.act.configuration_act import ACTConfig

from lerobot_constructskill.artifacts.code import code_of
from lerobot_constructskill.artifacts.digests import installed
from lerobot_constructskill.artifacts.store import Store

FILES = {
    "lerobot_policy_theirs/__init__.py": "",
    "lerobot_policy_theirs/modeling_theirs.py": "import torch, their_layers\n\ntext = '''\nfrom another page\n'''\n",
    "their_layers.py": "import numpy\n\nWIDTH = 64\n",
    "lerobot_policy_theirs/meshes/brick.obj": "v 0 0 0\n",
    "another.py": "WIDTH = 64\n",
}
DEFINES = "lerobot_policy_theirs.modeling_theirs"


@pytest.fixture
def folder(tmp_path: Path, monkeypatch):
    for name, text in FILES.items():
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).write_text(text)
    monkeypatch.syspath_prepend(tmp_path)
    return tmp_path


def told() -> dict[str, str]:
    return code_of(DEFINES)


def install(folder: Path) -> None:
    """As an editable installation leaves it: metadata that list no package."""
    metadata = folder / "lerobot_policy_theirs-1.2.dist-info" / "METADATA"
    metadata.parent.mkdir()
    metadata.write_text("Metadata-Version: 2.1\nName: lerobot_policy_theirs\nVersion: 1.2\n")


BESIDE = (".modeling_theirs.py.swp", "4913", "modeling_theirs.py~", "run.log", ".git/index", "__pycache__/a.pyc")


@pytest.mark.parametrize("name", BESIDE)
def test_what_an_editor_or_a_run_leaves_beside_code_is_none_of_it(name, folder):
    before, file = told(), folder / "lerobot_policy_theirs" / name
    file.parent.mkdir(exist_ok=True)
    file.write_text("open")
    assert told() == before


def test_a_folder_called_like_an_absent_package_is_no_code(folder):
    (folder / "their_layers.py").write_text("try:\n    import wandb\nexcept ImportError:\n    wandb = None\n")
    before = told()
    (folder / "wandb").mkdir()
    (folder / "wandb" / "run.json").write_text("{}")
    assert told() == before


def test_what_cannot_be_parsed_is_hashed_all_the_same(folder):
    before = told()
    (folder / "their_layers.py").write_text(f"x = {'-' * 20_000}1\n")
    assert told() != before


@pytest.mark.parametrize("is_installed", [True, False])
def test_code_is_told_by_its_source_on_a_path_or_installed(is_installed, folder):
    if is_installed:
        install(folder)
    installed.cache_clear()
    (name, code), *others = told().items()
    assert name == "lerobot_policy_theirs" and not others
    assert code.startswith("1.2, source " if is_installed else "source ") and len(code.split()[-1]) == 12


@pytest.mark.parametrize(("edited", "matters"), [(name, name != "another.py") for name in FILES])
def test_an_edit_of_a_line_is_other_code_and_of_what_is_not_imported_is_none(edited, matters, folder):
    before = told()
    (folder / edited).write_text(FILES[edited] + "WIDTH = 65\n")
    assert (told() != before) == matters
    (folder / edited).write_text(FILES[edited])
    assert told() == before


def test_a_moved_folder_is_the_same_code_and_a_new_file_is_not(folder, tmp_path_factory, monkeypatch):
    before, moved = told(), tmp_path_factory.mktemp("moved") / "site"
    folder.rename(moved)
    monkeypatch.syspath_prepend(moved)
    assert told() == before
    (moved / "lerobot_policy_theirs" / "more.py").touch()
    assert told() != before


def test_lerobots_code_and_ours_go_by_their_versions():
    assert code_of(ACTConfig.__module__, f"{Store.__module__}:Store", "pathlib", "__main__") == {}
