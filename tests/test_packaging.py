"""What an installed copy owes: LeRobot finds it, its commands start fast, no file names a registry."""

import json
import os
import re
import subprocess
import sys
import tarfile
import tomllib
import zipfile
from collections.abc import Callable
from functools import partial
from importlib import import_module, metadata
from pathlib import Path

import pytest
from commands import call_inside

from lerobot_constructskill import presets
from lerobot_constructskill.errors import MissingError
from lerobot_constructskill.scripts.config import show

REPOSITORY = Path(__file__).parents[1]
PYPROJECT = tomllib.loads((REPOSITORY / "pyproject.toml").read_text())
PROJECT = PYPROJECT["project"]
SMOKE = REPOSITORY / "configs" / "generate" / "smoke.yaml"

REGISTRIES = [
    ".".join(parts)
    for parts in (
        ("pypi", "org"),
        ("pythonhosted", "org"),
        ("download", "pytorch", "org"),
        ("pypi", "nvidia", "com"),
        ("anaconda", "org"),
        ("deb", "debian", "org"),
        ("security", "debian", "org"),
        ("archive", "ubuntu", "com"),
        ("ppa", "launchpadcontent", "net"),
        ("npmjs", "org"),
    )
]


def run_python(code: str) -> str:
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, cwd=REPOSITORY)
    assert done.returncode == 0, done.stderr
    return done.stdout


def test_distribution_keeps_its_underscores() -> None:
    """LeRobot imports the raw name of a distribution as a module."""
    assert metadata.distribution(PROJECT["name"]).metadata["Name"] == "lerobot_env_constructskill"


REGISTER = """
import json, sys
sys.modules["sapien"] = sys.modules["mani_skill"] = None
from lerobot.configs import PreTrainedConfig
from lerobot.envs.configs import EnvConfig
import lerobot.optim
theirs = set(sys.modules)
import lerobot_env_constructskill
imported = [name for name in sys.modules if name not in theirs]
print(json.dumps([imported, list(PreTrainedConfig.get_known_choices()), list(EnvConfig.get_known_choices())]))
"""


@pytest.mark.slow
def test_plugin_registers_without_simulator_or_model() -> None:
    imported, policies, envs = json.loads(run_python(REGISTER).splitlines()[-1])
    assert "frozen_vit" in policies
    assert "constructskill" in envs
    heavy = {"sapien", "mani_skill", "timm", "lerobot_constructskill.policies.frozen_vit.modeling_frozen_vit"}
    assert not heavy & set(imported)
    assert not [name for name in imported if name.startswith(("transformers.models", "lerobot_constructskill.sim"))]


HELP = """
import contextlib, importlib.metadata, io, os, sys
for command, target in {scripts}.items():
    os.environ.pop("OMP_WAIT_POLICY", None)
    sys.argv = [command, "--help"]
    with contextlib.redirect_stdout(io.StringIO()) as help:
        try:
            importlib.metadata.EntryPoint(command, target, "console_scripts").load()()
        except SystemExit as exit:
            assert not exit.code, f"{{command}} --help ends with {{exit.code}}"
    assert f"usage: {{command}}" in help.getvalue(), f"{{command}} --help prints no help"
    assert "torch" not in sys.modules, f"{{command}} --help imports torch"
    assert os.environ["OMP_WAIT_POLICY"] == "PASSIVE", f"the threads of {{command}} will spin"
"""


def test_help_does_not_wait_for_torch() -> None:
    run_python(HELP.format(scripts=PROJECT["scripts"]))


@pytest.fixture(scope="module")
def built(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of a wheel, made through a source distribution as a package index gets it."""
    folder = tmp_path_factory.mktemp("dist")
    code = [sys.executable, "-m", "build", "--no-isolation", "--outdir", folder, REPOSITORY]
    done = subprocess.run(code, capture_output=True, text=True)
    assert done.returncode == 0, done.stdout[-2000:] + done.stderr[-2000:]
    return folder


def test_wheel_and_source_distribution_are_small_and_hold_the_package_alone(built: Path) -> None:
    (wheel,), (source,) = built.glob("*.whl"), built.glob("*.tar.gz")
    with zipfile.ZipFile(wheel) as archive, tarfile.open(source) as sources:
        held, kept = archive.namelist(), sources.getnames()
    rooms = {"lerobot_constructskill", "lerobot_env_constructskill.py", f"{wheel.name.rsplit('-', 3)[0]}.dist-info"}
    assert {name.partition("/")[0] for name in held} == rooms
    assert "lerobot_constructskill/py.typed" in held
    assert not [name for name in kept if "/results/" in name or "/docs/" in name]
    assert max(wheel.stat().st_size, source.stat().st_size) < 1e6


def test_an_installed_copy_finds_its_configurations_from_an_empty_folder(built: Path, tmp_path: Path) -> None:
    installed, elsewhere = tmp_path / "installed", tmp_path / "elsewhere"
    zipfile.ZipFile(next(built.glob("*.whl"))).extractall(installed)
    elsewhere.mkdir()
    code = "from lerobot_constructskill.scripts.config import show_or_write; show_or_write.main()"
    command = [sys.executable, "-c", code]
    surroundings = os.environ | {"PYTHONPATH": str(installed)}
    done = subprocess.run(command, env=surroundings, cwd=elsewhere, capture_output=True, text=True)
    assert done.stdout.rstrip() == show(), done.stderr
    one = subprocess.run([*command, "study/paper"], env=surroundings, cwd=elsewhere, capture_output=True, text=True)
    assert one.stdout.strip() == str(installed / "lerobot_constructskill" / "configs" / "study" / "paper.yaml")
    assert presets.FOLDER == REPOSITORY / "configs", "a checkout reads its own files"


def test_every_configuration_has_a_name_and_says_what_it_is() -> None:
    named = {presets.find(kind, name) for kind in presets.KINDS for name in presets.names(kind)}
    assert named == set((REPOSITORY / "configs").rglob("*.yaml"))
    lines = show().splitlines()
    assert len(lines) == len(named) and all(len(line.split()) > 3 for line in lines)
    assert show("study/paper") == str(REPOSITORY / "configs" / "study" / "paper.yaml")


def test_a_name_wins_over_a_file_called_like_it(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    for name in "fast", "mine", "mine.yaml":
        (tmp_path / name).touch()
    assert presets.find("generate", "fast") == REPOSITORY / "configs" / "generate" / "fast.yaml"
    assert presets.find("generate", "mine") == Path("mine")
    assert presets.find("generate", tmp_path / "mine.yaml") == tmp_path / "mine.yaml"


@pytest.mark.parametrize("name", ["absent", "absent.yaml", "train/act", "../train/act", "suite", ""])
def test_a_name_that_is_none_is_answered_with_those_there_are(name: str) -> None:
    with pytest.raises(MissingError, match=f"'{name}'.* fast, .* suite/block_to_bin"):
        presets.find("generate", name)


@pytest.fixture
def generate() -> Callable[..., tuple[int, str, str]]:
    """Call a command in this process that prints some fields and makes nothing."""
    main = import_module("lerobot_constructskill.scripts.generate").generate.main
    config_class, _, *others = main.args
    told = partial(
        main.func, config_class, lambda config: f"{config.task} {config.episodes} {config.repo_id}", *others
    )
    return lambda *arguments: call_inside(told, "constructskill-generate", *arguments)


@pytest.mark.parametrize("named", ["smoke", f"{SMOKE}", f"--config_path={SMOKE}"], ids=["name", "file", "flag"])
def test_a_command_takes_a_name_a_file_or_a_flag(named: str, generate: Callable[..., tuple[int, str, str]]) -> None:
    assert generate(named, "--repo_id=a/b") == (0, "brick_to_bin 2 a/b\n", "")


@pytest.mark.parametrize(
    ("arguments", "said"),
    [(["fsat"], "'fsat'; the configurations are: direct, "), (["fast", "--config_path=x"], "give only one")],
)
def test_a_command_tells_what_is_wrong_with_a_name(
    arguments: list[str], said: str, generate: Callable[..., tuple[int, str, str]]
) -> None:
    status, printed, told = generate(*arguments)
    assert status == 1 and not printed and said in told and len(told.splitlines()) == 1


def own_files() -> list[str]:
    """Every file that is, or would be, committed."""
    listing = ["git", "ls-files", "--cached", "--others", "--exclude-standard", "-z"]
    done = subprocess.run(listing, capture_output=True, text=True, cwd=REPOSITORY)
    if done.returncode != 0:
        pytest.skip("not a git checkout")
    return [name for name in done.stdout.split("\0") if name and (REPOSITORY / name).is_file()]


def test_no_message_of_an_installed_copy_needs_a_checkout() -> None:
    sources = (REPOSITORY / "lerobot_constructskill").rglob("*.py")
    assert not [path.name for path in sources if re.search(r"`make ", path.read_text())]


def test_no_file_names_a_package_registry() -> None:
    text = {name: (REPOSITORY / name).read_text(errors="ignore") for name in own_files()}
    assert not [(name, host) for name, body in text.items() for host in REGISTRIES if host in body]


def test_constraints_are_exact_and_without_addresses() -> None:
    lines = (REPOSITORY / "constraints.txt").read_text().splitlines()
    lines = [line for line in lines if not line.startswith("#")]
    pins = dict(line.split("==") for line in lines)
    assert {"lerobot", "mani-skill", "sapien", "torch", "opencv-python-headless"} <= pins.keys()
    assert not {"opencv-python", "mplib", "openvino-telemetry"} & pins.keys()
    assert not [line for line in lines if "/" in line or "@" in line]
