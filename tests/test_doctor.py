"""The doctor's answers on made-up machines, and on this one."""

import re
from pathlib import Path
from types import SimpleNamespace

import pytest

from lerobot_constructskill.errors import InputError
from lerobot_constructskill.scripts import doctor
from lerobot_constructskill.scripts.doctor import FAIL, OK, PROBES, WARN, Probe, answer, compare_versions, diagnose

REPOSITORY = Path(__file__).parents[1]
REQUIREMENTS = ["lerobot[dataset]<0.7,>=0.6.1", "sapien<3.1,>=3.0.3; extra == 'sim'", "ruff; extra == 'dev'"]


@pytest.fixture
def installed(monkeypatch):
    """Replace the installed packages by others, name to version."""

    def install(**versions: str) -> None:
        found = [SimpleNamespace(name=name, version=version) for name, version in versions.items()]
        monkeypatch.setattr(doctor.metadata, "distributions", lambda: found)

    return install


def test_versions_within_their_bounds_are_listed_and_an_extra_may_be_absent(installed):
    installed(lerobot="0.6.1", sapien="3.0.3")
    assert compare_versions(REQUIREMENTS) == "lerobot 0.6.1, sapien 3.0.3"
    installed(lerobot="0.6.1")
    assert compare_versions(REQUIREMENTS) == "lerobot 0.6.1"


@pytest.mark.parametrize(
    ("versions", "said"),
    [
        ({"lerobot": "0.7.0", "sapien": "3.0.3"}, "lerobot is 0.7.0 (needs <0.7,>=0.6.1)."),
        ({"sapien": "3.0.3"}, "lerobot is absent (needs <0.7,>=0.6.1)."),
        ({"lerobot": "0.6.1", "sapien": "4"}, "sapien is 4 (needs <3.1,>=3.0.3)."),
    ],
)
def test_versions_out_of_their_bounds_are_named(versions, said, installed):
    installed(**versions)
    with pytest.raises(InputError) as refused:
        compare_versions(REQUIREMENTS)
    assert str(refused.value) == said


def test_the_pinned_lerobot_was_tried_and_so_says_the_page() -> None:
    pins, page = ((REPOSITORY / name).read_text() for name in ("constraints.txt", "docs/lerobot.md"))
    assert f"| {re.search(r'^lerobot==(.*)$', pins, re.MULTILINE)[1]} |" in page


RIGHT, ODD, WRONG = (
    Probe("Thing", "print('before'); print('all is well')", "do it"),
    Probe("Thing", "raise RuntimeError('a\\nodd thing.')", "do that", WARN),
    Probe("Thing", "import os, signal; os.kill(os.getpid(), signal.SIGSEGV)", "buy another machine"),
)


def test_an_answer_is_the_last_line_and_a_complaint_ends_in_what_to_do() -> None:
    assert answer(RIGHT) == (OK, "all is well")
    assert answer(ODD) == (WARN, "odd thing; do that.")
    assert answer(WRONG) == (FAIL, "the process died of signal 11; buy another machine.")


@pytest.mark.parametrize(("probes", "status"), [([RIGHT], 0), ([RIGHT, ODD], 0), ([RIGHT, WRONG], 1), ([ODD], 1)])
def test_exit_status(probes: list[Probe], status: int, capsys: pytest.CaptureFixture[str]) -> None:
    assert diagnose(probes) == status
    assert capsys.readouterr().out.startswith(answer(probes[0])[0])


@pytest.mark.slow
@pytest.mark.sim
@pytest.mark.parametrize("probe", PROBES, ids=lambda probe: probe.name)
def test_nothing_is_wrong_with_the_machine_that_tests(probe: Probe) -> None:
    level, said = answer(probe)
    assert level == OK or probe.level == WARN, said
    assert "\n" not in said
