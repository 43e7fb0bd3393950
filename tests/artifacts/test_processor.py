"""What this machine's processor is called."""

import platform

import pytest

from lerobot_constructskill.artifacts import processor as of

XEON = "processor\t: 0\ncpu family\t: 6\nmodel\t\t: 106\nmodel name\t: Xeon: a name\n\n"


@pytest.mark.parametrize(
    ("said", "name"),
    [
        (XEON + XEON.replace("106", "1"), "Xeon: a name (family 6, model 106)"),
        ("model name : of no family\n", "of no family"),
        ("Features : fp asimd\n", platform.machine()),
        (None, platform.machine()),
    ],
)
def test_the_first_processors_name_family_and_model(said, name, tmp_path, monkeypatch):
    path = tmp_path / "cpuinfo"
    if said is not None:
        path.write_text(said)
    monkeypatch.setattr(of, "CPUINFO", path)
    assert of.processor.__wrapped__() == name


@pytest.mark.parametrize(("said", "name"), [("vendor_id\t: GenuineIntel\n", "GenuineIntel"), ("", platform.machine())])
def test_its_make(said, name, tmp_path, monkeypatch):
    path = tmp_path / "cpuinfo"
    path.write_text(said)
    monkeypatch.setattr(of, "CPUINFO", path)
    assert of.make.__wrapped__() == name
