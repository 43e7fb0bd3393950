"""Which Vulkan drivers SAPIEN is shown, on made-up machines."""

import os

import pytest

from lerobot_constructskill.sim import drivers

MESA = "usr/share/vulkan/icd.d/lvp_icd.x86_64.json"


@pytest.fixture
def machine(tmp_path, monkeypatch):
    """Make a machine with these driver files; `gpu` says whether it has nvidia-smi."""
    for name in drivers.CHOICES:
        monkeypatch.delenv(name, raising=False)

    def make(*files: str, gpu: bool = True):
        folders = [tmp_path / folder.relative_to("/") for folder in drivers.FOLDERS]
        monkeypatch.setattr(drivers, "FOLDERS", folders)
        monkeypatch.setattr(drivers.shutil, "which", lambda name: f"/usr/bin/{name}" if gpu else None)
        for file in files:
            (tmp_path / file).parent.mkdir(parents=True, exist_ok=True)
            (tmp_path / file).touch()
        drivers.show_all_drivers()
        named = os.environ.get("VK_ICD_FILENAMES", "")
        return [file.removeprefix(f"{tmp_path}/") for file in named.split(os.pathsep) if file]

    yield make
    os.environ.pop("VK_ICD_FILENAMES", None)


def test_a_driver_of_a_container_toolkit_does_not_hide_mesas(machine):
    toolkits = "etc/vulkan/icd.d/nvidia_icd.json"
    assert machine(toolkits, MESA) == [toolkits, MESA]


def test_where_nvidias_file_is_missing_sapiens_own_stands_beside_mesas(machine):
    mesa, own = machine(MESA)
    assert mesa == MESA and own.endswith("sapien/vulkan_library/nvidia_icd.json") and os.path.exists(own)


@pytest.mark.parametrize("gpu", [False, True])
def test_where_sapien_hides_nothing_nothing_is_named(machine, gpu):
    assert machine(MESA, *["usr/share/vulkan/icd.d/nvidia_icd.json"] * gpu, gpu=gpu) == []


@pytest.mark.parametrize("name", drivers.CHOICES)
def test_what_the_user_has_chosen_stays(machine, monkeypatch, name):
    monkeypatch.setenv(name, "mine.json")
    assert machine(MESA) == ["mine.json"] * (name == "VK_ICD_FILENAMES")
