"""The doctor's judgements on made-up machines."""

import ast
import re
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
        (checks.judge_versions(REQUIREMENTS, {"lerobot": "0.6.1", "sapien": "3.0.3"}), Level.OK),
        (checks.judge_versions(REQUIREMENTS, {"lerobot": "0.6.1"}), Level.WARN),
        (checks.judge_versions(REQUIREMENTS, {"lerobot": "0.7.0", "sapien": "3.0.3"}), Level.FAIL),
        (checks.judge_versions(REQUIREMENTS, {"sapien": "3.0.3"}), Level.FAIL),
        (checks.judge_opencv({"opencv-python-headless": "4.12"}), Level.OK),
        (checks.judge_opencv(dict.fromkeys(checks.OPENCV, "4.12")), Level.WARN),
        (checks.judge_opencv({}), Level.FAIL),
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
    assert "install libpython3.13." in checks.judge_ffmpeg(Probe(False, "", "libpython3.13.so.1.0: not found")).message
    assert "none for b" in checks.judge_weights(Probe(True, "a\tHub\nb\t", "")).message


def test_a_check_has_one_name_whatever_it_finds() -> None:
    functions = [
        node for node in ast.parse(Path(checks.__file__).read_text()).body if isinstance(node, ast.FunctionDef)
    ]
    for function in functions:
        calls = [node for node in ast.walk(function) if isinstance(node, ast.Call)]
        found = [call.args for call in calls if ast.unparse(call.func) == "Finding"]
        assert len({ast.unparse(name) for _, name, _ in found}) <= 1, function.name


def test_the_pinned_lerobot_was_tried_and_so_says_the_page() -> None:
    pins, page = ((REPOSITORY / name).read_text() for name in ("constraints.txt", "docs/lerobot.md"))
    assert f"| {re.search(r'^lerobot==(.*)$', pins, re.MULTILINE)[1]} |" in page


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
