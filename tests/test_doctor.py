"""The doctor's judgements on made-up machines, and the functions of setup.sh on made-up files."""

import subprocess
import sys
from pathlib import Path

import pytest

from lerobot_constructskill.scripts import doctor_checks as checks
from lerobot_constructskill.scripts.doctor import diagnose, probe
from lerobot_constructskill.scripts.doctor_checks import Finding, Level, Probe

REPOSITORY = Path(__file__).parents[1]
REQUIREMENTS = ["lerobot[dataset]<0.7,>=0.6.1", "sapien<3.1,>=3.0.3; extra == 'sim'", "ruff; extra == 'dev'"]
RENDERS = Probe(True, "cpu\tFalse", "")
OLD_DRIVER = Probe(True, "\tThe NVIDIA driver on your system is too old (found version 11040).", "")
BROKEN = Probe(False, "", "RuntimeError: no such thing")


@pytest.mark.parametrize(
    ("finding", "level"),
    [
        (checks.judge_python((3, 12)), Level.OK),
        (checks.judge_python((3, 11)), Level.FAIL),
        (checks.judge_python((3, 13)), Level.OK),
        (checks.judge_python((3, 14)), Level.WARN),
        (checks.judge_bytecode(kept=True, compiled=False, folder="/site"), Level.OK),
        (checks.judge_bytecode(kept=False, compiled=True, folder="/site"), Level.OK),
        (checks.judge_bytecode(kept=False, compiled=False, folder="/site"), Level.WARN),
        (checks.judge_name(["numpy", "lerobot_env_constructskill"]), Level.OK),
        (checks.judge_name(["lerobot-env-constructskill"]), Level.FAIL),
        (checks.judge_name([]), Level.FAIL),
        (checks.judge_versions(REQUIREMENTS, {"lerobot": "0.6.1", "sapien": "3.0.3"}), Level.OK),
        (checks.judge_versions(REQUIREMENTS, {"lerobot": "0.6.1"}), Level.WARN),
        (checks.judge_versions(REQUIREMENTS, {"lerobot": "0.7.0", "sapien": "3.0.3"}), Level.FAIL),
        (checks.judge_versions(REQUIREMENTS, {"sapien": "3.0.3"}), Level.FAIL),
        (checks.judge_lerobot("0.6.2"), Level.OK),
        (checks.judge_lerobot("0.7.0"), Level.WARN),
        (checks.judge_lerobot(None), Level.FAIL),
        (checks.judge_opencv({"opencv-python-headless": "4.12"}), Level.OK),
        (checks.judge_opencv(dict.fromkeys(checks.OPENCV, "4.12")), Level.WARN),
        (checks.judge_opencv({}), Level.FAIL),
        (checks.judge_mesa("25.0.7-2~bpo12+1", gpu=False), Level.OK),
        (checks.judge_mesa("24.3.0-1", gpu=False), Level.OK),
        (checks.judge_mesa("22.3.6-1+deb12u2", gpu=False), Level.FAIL),
        (checks.judge_mesa("24.2.8-1ubuntu1", gpu=False), Level.FAIL),
        (checks.judge_mesa(None, gpu=False), Level.WARN),
        (checks.judge_mesa("22.3.6", gpu=True), Level.OK),
        (checks.judge_vulkan(RENDERS, simulator=True), Level.OK),
        (checks.judge_vulkan(RENDERS, simulator=True, gpu=True), Level.WARN),
        (checks.judge_vulkan(Probe(True, "NVIDIA H100\tTrue", ""), simulator=True, gpu=True), Level.OK),
        (checks.judge_vulkan(BROKEN, simulator=True), Level.FAIL),
        (checks.judge_vulkan(BROKEN, simulator=False), Level.WARN),
        (checks.judge_cuda(Probe(True, "NVIDIA H100", ""), gpu=True), Level.OK),
        (checks.judge_cuda(Probe(True, "", ""), gpu=False), Level.OK),
        (checks.judge_cuda(OLD_DRIVER, gpu=True), Level.WARN),
        (checks.judge_cuda(BROKEN, gpu=False), Level.FAIL),
        (checks.judge_plugin(Probe(True, "said before\nTrue True", "")), Level.OK),
        (checks.judge_plugin(Probe(True, "True False", "")), Level.FAIL),
        (checks.judge_plugin(BROKEN), Level.FAIL),
        (checks.judge_ffmpeg(RENDERS), Level.OK),
        (checks.judge_ffmpeg(BROKEN), Level.WARN),
        (checks.judge_encoder(Probe(True, "said before\nfloat32 openvino cpu 14.9", "")), Level.OK),
        (checks.judge_encoder(Probe(True, "float32 torch cpu 8.5", "")), Level.WARN),
        (checks.judge_encoder(BROKEN), Level.FAIL),
        (checks.judge_weights(Probe(True, "said before\na\tHub\nb\tHub cache", "")), Level.OK),
        (checks.judge_weights(Probe(True, "a\tHub\nb\t", "")), Level.WARN),
        (checks.judge_weights(Probe(True, "a\t\nb\t", "")), Level.FAIL),
        (checks.judge_weights(BROKEN), Level.FAIL),
        (checks.judge_fetched("a", Probe(True, "said before\nHub\t" + "0" * 64, "")), Level.OK),
        (checks.judge_fetched("a", BROKEN), Level.WARN),
    ],
)
def test_judgement(finding: Finding, level: Level) -> None:
    assert finding.level == level, finding
    assert "\n" not in finding.message
    assert level is Level.OK or finding.message.endswith("."), "a complaint is a sentence that says what to do"


def test_complaints_name_their_cause() -> None:
    both = dict.fromkeys(checks.OPENCV[:2], "4.12")
    assert "-y opencv-python opencv-python-headless && pip install opencv-python-headless==4.12." in (
        checks.judge_opencv(both).message
    )
    versions = checks.judge_versions(REQUIREMENTS, {"lerobot": "0.5"}).message
    assert versions == "lerobot is 0.5 (needs <0.7,>=0.6.1); pip install 'lerobot[dataset]<0.7,>=0.6.1'."
    assert "no such thing" in checks.judge_vulkan(BROKEN, simulator=True).message
    assert "system is too old (found version 11040)); install" in checks.judge_cuda(OLD_DRIVER, gpu=True).message
    assert "0.7.0 was not tried" in checks.judge_lerobot("0.7.0").message
    assert "install libpython3.13." in checks.judge_ffmpeg(Probe(False, "", "libpython3.13.so.1.0: not found")).message
    assert "none for b" in checks.judge_weights(Probe(True, "a\tHub\nb\t", "")).message


def test_the_pinned_lerobot_was_tried_and_so_says_the_page() -> None:
    pins, page = ((REPOSITORY / name).read_text() for name in ("constraints.txt", "docs/lerobot.md"))
    assert any(f"\nlerobot=={version}\n" in pins for version in checks.LEROBOTS)
    assert all(f"| {version} |" in page for version in checks.LEROBOTS)


@pytest.mark.parametrize(
    ("levels", "status"),
    [([Level.OK], 0), ([Level.OK, Level.WARN], 0), ([Level.OK, Level.FAIL], 1), ([Level.WARN], 1)],
)
def test_exit_status(levels: list[Level], status: int, capsys: pytest.CaptureFixture[str]) -> None:
    assert diagnose([lambda level=level: Finding(level, "Thing", "a message.") for level in levels]) == status
    assert capsys.readouterr().out.startswith(f"{levels[0]}")


def test_probe_survives_what_it_runs() -> None:
    assert probe("print('hello')") == Probe(True, "hello", "")
    assert probe("raise RuntimeError('a\\nb')").reason == "b"
    assert "signal" in probe("import os, signal; os.kill(os.getpid(), signal.SIGSEGV)").reason


def shell(snippet: str, *arguments: str | Path) -> subprocess.CompletedProcess[str]:
    """Run a snippet with the functions of setup.sh at hand."""
    code = f"source '{REPOSITORY / 'setup.sh'}'; {snippet}"
    return subprocess.run(["bash", "-c", code, "bash", *map(str, arguments)], capture_output=True, text=True)


def test_setup_and_doctor_want_the_same_mesa_and_pythons() -> None:
    wanted = shell('echo "$MESA_MINIMUM $PYTHON_VERSIONS"').stdout.split()
    assert wanted == [".".join(map(str, version)) for version in (checks.MESA_MINIMUM, *checks.PYTHONS)]


DEB822 = """\
# A comment
Types: deb-src
URIs: http://sources.example/debian
Suites: bookworm

Types: deb
Enabled: no
URIs: http://disabled.example/debian
Suites: bookworm

Types: deb
# between two fields
URIs: http://mirror.example/debian http://second.example/debian
Suites: bookworm bookworm-updates
Components: main
Signed-By: /keys/debian.gpg

Types: deb
URIs: http://security.example/debian
Suites: bookworm-security
"""
ONE_LINE = """\
#deb http://comment.example/debian bookworm main
deb-src http://sources.example/debian bookworm main
deb http://security.example/debian bookworm-security main
deb [arch=amd64 signed-by=/keys/debian.gpg] http://mirror.example/debian bookworm main contrib
"""


@pytest.mark.parametrize(
    ("file", "text", "signed"),
    [
        ("sources.list.d/debian.sources", DEB822, True),
        ("sources.list", ONE_LINE, True),
        ("sources.list.d/debian.list", ONE_LINE, True),
        ("sources.list", "deb http://mirror.example/debian bookworm main\n", False),
    ],
)
def test_backports_come_from_the_machines_own_mirror(tmp_path: Path, file: str, text: str, signed: bool) -> None:
    (tmp_path / "sources.list.d").mkdir()
    (tmp_path / file).write_text(text)
    stanza = shell('backports_stanza "$1" bookworm', tmp_path)
    assert stanza.returncode == 0, stanza.stderr
    lines = [
        "Types: deb",
        "URIs: http://mirror.example/debian",
        "Suites: bookworm-backports",
        "Components: main",
    ]
    assert stanza.stdout.splitlines() == lines + ["Signed-By: /keys/debian.gpg"] * signed
    assert shell('backports_stanza "$1" trixie', tmp_path).returncode != 0


@pytest.mark.parametrize(("version", "good"), [("22.3.6-1+deb12u2", False), ("25.0.7-2~bpo12+1", True), ("", False)])
def test_setup_judges_mesa(version: str, good: bool) -> None:
    assert (shell('new_enough "$1"', version).returncode == 0) is good


@pytest.mark.parametrize("lists", [False, True])
def test_setup_asks_apt_anew_where_its_lists_are_gone(lists: bool, tmp_path: Path) -> None:
    """An old Mesa is as good as it gets only where apt knows what it could install."""
    (tmp_path / "var/lib/apt/lists").mkdir(parents=True)
    if lists:
        (tmp_path / "var/lib/apt/lists/mirror_main_binary-amd64_Packages.lz4").touch()
    assert (shell('knows_of_packages "$1"', tmp_path).returncode == 0) is lists


@pytest.mark.parametrize(
    ("machine", "refused", "said"),
    [
        ("Linux x86_64", False, ""),
        ("Darwin arm64", False, "never tried on macOS"),
        ("Linux aarch64", True, "no wheel for Linux aarch64"),
        ("Darwin x86_64", True, "no wheel for Darwin x86_64"),
    ],
)
def test_setup_refuses_a_machine_without_wheels(machine: str, refused: bool, said: str) -> None:
    checked = shell('machine=$1; uname() { echo "$machine"; }; check_machine', machine)
    assert (checked.returncode != 0) is refused
    assert said in checked.stderr
    assert len(checked.stderr.splitlines()) == bool(said)


def test_setup_passes_over_a_python_that_does_not_run(tmp_path: Path) -> None:
    shim = tmp_path / "python3.12"
    shim.write_text("#!/bin/sh\necho 'python3.12: command not found' >&2\nexit 127\n")
    shim.chmod(0o755)
    assert shell('is_right_python "$1"', shim).returncode != 0
    working = Path(sys.executable).with_name("python3.12")
    found = shell('PATH="$1:$2:$PATH" find_python', tmp_path, working.parent)
    assert found.stdout.strip() == str(working)


@pytest.mark.parametrize(
    ("versions", "taken"), [(("3.11", "3.12", "3.13"), "3.12"), (("3.11", "3.13"), "3.13"), (("3.11",), None)]
)
def test_setup_takes_python_3_12_then_3_13_then_what_uv_has(
    tmp_path: Path, versions: tuple[str, ...], taken: str | None
) -> None:
    (tmp_path / "uv").write_text(
        "#!/bin/sh\nprintf 'error: not installed\n  cause: request: no network\n' >&2\nexit 1\n"
    )
    for version in versions:
        (tmp_path / f"python{version}").write_text(f"#!/bin/sh\ncase $2 in *{version}*) ;; *) exit 1 ;; esac\n")
    for program in tmp_path.iterdir():
        program.chmod(0o755)
    found = shell("UV=$1/uv PATH=$1 PYENV_ROOT=$1; find_python", tmp_path)
    if taken:
        assert found.stdout.strip() == str(tmp_path / f"python{taken}")
    else:
        *_, last = found.stderr.splitlines()
        assert found.returncode != 0
        assert "no Python 3.12 or 3.13 here" in last and "(no network)" in last
