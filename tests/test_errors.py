"""Whatever goes wrong in a console command: one sentence and a status for the user, the traceback in a log."""

import ast
import pickle
import re
import subprocess
import sys
import tempfile
import tomllib
from collections.abc import Callable, Iterator
from importlib.metadata import EntryPoint
from pathlib import Path

import pytest
from commands import call_inside

from lerobot_constructskill import parsing
from lerobot_constructskill.errors import (
    FieldError,
    InputError,
    MachineError,
    MissingError,
    TakenError,
    UserError,
    as_field_error,
    full_traceback,
    remedy_of,
)

REPOSITORY = Path(__file__).parents[1]
MODULES = sorted((REPOSITORY / "lerobot_constructskill").rglob("*.py"))
PYTHONS = {"ValueError", "OSError", "FileNotFoundError", "FileExistsError"}
SCRIPTS = tomllib.loads((REPOSITORY / "pyproject.toml").read_text())["project"]["scripts"]

Run = Callable[..., tuple[int, str]]


@pytest.fixture
def run(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Run:
    """Call a command in this process, with an error in its first piece of work; return its status and what it said."""

    def call(command: str, *flags: str, error: BaseException | None = None, state: Path = tmp_path) -> tuple[int, str]:
        def broken(*arguments: object, **options: object) -> None:
            assert "--debug" not in sys.argv
            raise error

        main = EntryPoint(command, SCRIPTS[command], "console_scripts").load()
        with monkeypatch.context() as patch:
            patch.setattr(tempfile, "tempdir", str(tmp_path))
            patch.setenv("XDG_STATE_HOME", str(state))
            if error is not None:
                patch.setattr(parsing, "parse", broken)
                if command == "constructskill-doctor":  # it has no configuration to parse
                    patch.setattr(sys.modules[main.__module__], "diagnose", broken)
            status, _, said = call_inside(main, command, *flags)
        return status, said

    return call


@pytest.mark.parametrize("command", SCRIPTS)
def test_a_fault_of_ours_is_called_one_and_its_traceback_is_kept(command: str, run: Run, tmp_path: Path) -> None:
    status, printed = run(command, "--debug", error=KeyError("a b"))
    log = tmp_path / "constructskill" / f"{command}.log"
    said = f"this is a fault of constructskill, not of your input: KeyError: 'a b'; the traceback is in {log}\n"
    assert status == 70 and printed.endswith(f"{command}: {said}")
    for told in printed, log.read_text():
        assert "Traceback" in told and "in broken\n    raise error\nKeyError: 'a b'" in told


def test_fields_that_are_missing_or_unknown_are_named_in_the_users_words(run: Run, tmp_path: Path) -> None:
    said = "`--suite` and `--about` and `--root` are missing; `--help` says what they are."
    assert said in run("constructskill-submit")[1]
    study = tmp_path / "study.yaml"
    for text, told in (
        ("training: {epoch: 1}", "training has no field 'epoch'; it has epochs, batch_size"),
        ("training: {learning-rate: 1}", "training has no field 'learning-rate'; it has epochs"),
        ("nam: y", "The configuration has no field 'nam'; it has "),
        ("settings: {a: {}}", "`settings.a.data` is missing."),
    ):
        study.write_text(f"name: x\n{text}\n")
        assert told in run("constructskill-study", str(study))[1]


def test_without_debug_a_fault_is_one_sentence(run: Run, tmp_path: Path) -> None:
    for error in KeyError("a"), ValueError("operands could not be broadcast together"):
        status, printed = run("constructskill-report", error=error)
        assert status == 70 and len(printed.splitlines()) == 1
    assert (tmp_path / "constructskill" / "constructskill-report.log").read_text().count("Traceback") == 2


@pytest.mark.parametrize("command", SCRIPTS)
def test_what_the_user_can_mend_is_one_sentence(command: str, tmp_path: Path) -> None:
    """Of the command that is installed: the one true process for each."""
    call = [Path(sys.executable).parent / command, "--no_such_flag=3"]
    done = subprocess.run(call, capture_output=True, text=True, env={"XDG_STATE_HOME": str(tmp_path)})
    assert done.returncode == 1 and done.stderr == f"{command}: unrecognized arguments: --no_such_flag=3\n"
    assert "InputError" in (tmp_path / "constructskill" / f"{command}.log").read_text()


@pytest.mark.parametrize(
    ("error", "status", "said"),
    [
        (OSError(28, "No space left on device"), 1, "[Errno 28] No space left on device"),
        (ModuleNotFoundError("No module named x", name="x"), 1, "No module named x; constructskill-doctor says"),
        (ModuleNotFoundError("No module named sapien", name="sapien"), 1, "sapien is not installed; uv pip install '"),
        (ModuleNotFoundError("No module named jinja2", name="jinja2"), 1, "jinja2 is not installed; uv pip install '"),
        (KeyboardInterrupt(), 130, "interrupted"),
    ],
)
def test_what_is_no_fault_of_ours_is_not_called_one(error: BaseException, status: int, said: str, run: Run) -> None:
    ended, printed = run("constructskill-report", error=error)
    assert ended == status and printed.startswith(f"constructskill-report: {said}")
    assert len(printed.splitlines()) == 1


def test_a_reader_who_has_read_enough_is_no_fault(tmp_path: Path) -> None:
    done = subprocess.run(
        ["bash", "-c", f"set -o pipefail; {Path(sys.executable).parent}/constructskill-config | head -n 1 >/dev/null"],
        env={"XDG_STATE_HOME": str(tmp_path), "PATH": "/usr/bin:/bin"},
        capture_output=True,
        text=True,
    )
    assert done.returncode == 0 and not done.stderr and not list(tmp_path.iterdir())


@pytest.mark.parametrize("command", SCRIPTS)
def test_a_path_that_is_no_text_is_one_sentence(command: str, run: Run, tmp_path: Path) -> None:
    """Linux knows bytes, and hands each that is no UTF-8 to Python as half of a character."""
    status, printed = run(command, "--config_path=\udcff", "--no_such_flag=\udcff")
    assert status == 1 and len(printed.splitlines()) == 1
    assert "\\udcff" in (tmp_path / "constructskill" / f"{command}.log").read_text()


@pytest.mark.parametrize(
    ("closed", "status", "said"),
    [
        ("1>&-", 0, ""),
        ("2>&-", 0, ""),
        ("1>&- 2>&- <&-", 0, ""),
        (
            ">/dev/full",
            1,
            "constructskill-config: standard output cannot be written to (No space left on device); the work is "
            "done\n",
        ),
    ],
)
def test_nobody_who_listens_is_no_fault(closed: str, status: int, said: str, tmp_path: Path) -> None:
    command = f"{Path(sys.executable).parent}/constructskill-config {closed}"
    environment = {"XDG_STATE_HOME": str(tmp_path), "PATH": "/usr/bin:/bin"}
    done = subprocess.run(["bash", "-c", command], env=environment, capture_output=True, text=True)
    assert done.returncode == status and done.stderr == said


def test_a_locale_without_letters_is_no_fault(tmp_path: Path) -> None:
    """What is said is escaped, and what is written is UTF-8."""
    named = tmp_path / "é.yaml"
    named.write_text("repo_id: a/b\nroot: é\nepisodes: 0\n", encoding="utf-8")
    locale = {"LC_ALL": "C", "PYTHONUTF8": "0", "PYTHONCOERCECLOCALE": "0", "XDG_STATE_HOME": str(tmp_path)}
    command = [Path(sys.executable).parent / "constructskill-generate", named]
    done = subprocess.run(command, env=locale, capture_output=True, text=True)
    assert done.returncode == 1 and "episodes must be" in done.stderr and len(done.stderr.splitlines()) == 1
    assert "udcc3" in (tmp_path / "constructskill" / "constructskill-generate.log").read_text(encoding="utf-8")


def test_a_log_finds_its_place_where_the_home_folder_cannot_be_written(run: Run, tmp_path: Path) -> None:
    (tmp_path / "state").touch()  # a file, below which there can be no folder
    _, printed = run("constructskill-report", error=KeyError("a"), state=tmp_path / "state")
    log = Path(printed.strip().rsplit(" ", 1)[1])
    assert log.parent == tmp_path and "in broken\n    raise error\nKeyError: 'a'" in log.read_text()


@pytest.mark.parametrize("module", MODULES, ids=lambda path: path.stem)
def test_what_is_raised_for_the_user_is_told_from_what_python_raises(module: Path) -> None:
    raises = [node.exc for node in ast.walk(ast.parse(module.read_text())) if isinstance(node, ast.Raise)]
    raised = {ast.unparse(error.func) for error in raises if isinstance(error, ast.Call)}
    assert not raised & PYTHONS, "raise a class of errors.py, or RuntimeError where only a defect leads"


@pytest.mark.parametrize("kind", [InputError, FieldError, MissingError, TakenError, MachineError])
def test_a_sentence_survives_the_way_between_processes(kind: type[UserError]) -> None:
    error = pickle.loads(pickle.dumps(kind("a sentence.")))
    assert type(error) is kind and str(error) == "a sentence."


def test_the_traceback_tells_what_a_sentence_hides() -> None:
    try:
        try:
            {}["the cause"]
        except KeyError:
            raise InputError("a sentence.") from None
    except InputError as error:
        assert "KeyError: 'the cause'" in full_traceback(error)


def test_a_traceback_comes_home_from_a_simulators_process(monkeypatch) -> None:
    from lerobot_constructskill.rollout.simulators import _attempt, _environments, _reset

    class Broken:
        def reset(self, seed):
            raise KeyError(seed)

    class OddError(Exception):
        def __init__(self, one, two):
            super().__init__(f"{one} and {two}")

    class Odder:
        def reset(self, seed):
            raise OddError(seed, 8)

    monkeypatch.setitem(_environments, 0, Broken())
    monkeypatch.setitem(_environments, 1, Odder())
    error = pickle.loads(pickle.dumps(_attempt(_reset, 0, 7)))
    assert type(error) is KeyError and error.args == (7,)
    assert "in reset\n    raise KeyError(seed)" in full_traceback(error)
    error = pickle.loads(pickle.dumps(_attempt(_reset, 1, 7)))
    assert type(error) is RuntimeError and str(error) == "OddError: 7 and 8"


def test_a_missing_package_is_named_with_its_extra() -> None:
    for package, extra in ("mani_skill", "sim"), ("matplotlib", "study"), ("openvino", "cpu"), ("ray", "distributed"):
        remedy = remedy_of(ModuleNotFoundError(name=f"{package}.inner"))
        assert remedy == f"{package} is not installed; uv pip install 'lerobot_env_constructskill[{extra}]'."
    assert remedy_of(ModuleNotFoundError(name="elsewhere")) is None


WITHOUT_SIMULATOR = """
import sys
sys.modules["mani_skill"] = None
from lerobot_constructskill.envs.gym_env import ConstructSkillEnv
ConstructSkillEnv().reset(seed=0)
"""


def test_an_environment_without_its_simulator_says_what_to_install() -> None:
    done = subprocess.run([sys.executable, "-c", WITHOUT_SIMULATOR], capture_output=True, text=True)
    assert "uv pip install 'lerobot_env_constructskill[sim]'." in done.stderr.splitlines()[-1]


def test_what_lerobot_parses_is_refused_by_no_value_error() -> None:
    with pytest.raises(FieldError, match="a sentence") as refusal, as_field_error():
        raise InputError("a sentence.")
    assert not isinstance(refusal.value, ValueError)


def said(path: Path) -> Iterator[str]:
    """The strings of a file but for its docstrings."""
    nodes = list(ast.walk(ast.parse(path.read_text())))
    docstrings = {node.value for node in nodes if isinstance(node, ast.Expr)}
    strings = (node for node in nodes if isinstance(node, ast.Constant) and isinstance(node.value, str))
    yield from (node.value for node in strings if node not in docstrings)


@pytest.mark.parametrize("room", ["policies", "features"])
def test_what_our_commands_and_lerobots_share_names_fields_and_no_flags_of_one(room: str) -> None:
    """`--policy.backbone_path` is `--backbone_path` for constructskill-encode, and a line of YAML for a study."""
    texts = [text for path in MODULES if room in path.parts for text in said(path)]
    assert texts and not [text for text in texts if re.search(r"--(policy|dataset|env)\.", text)]
