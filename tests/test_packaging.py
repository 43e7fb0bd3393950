"""What an installed copy owes: LeRobot finds it, its commands start fast, no file names a registry."""

import json
import subprocess
import sys
import tomllib
from importlib import metadata
from pathlib import Path

import pytest

REPOSITORY = Path(__file__).parents[1]
PROJECT = tomllib.loads((REPOSITORY / "pyproject.toml").read_text())["project"]

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


def test_plugin_registers_without_simulator_or_model() -> None:
    imported, policies, envs = json.loads(run_python(REGISTER).splitlines()[-1])
    assert "frozen_vit" in policies
    assert "constructskill" in envs
    heavy = {"sapien", "mani_skill", "timm", "lerobot_constructskill.policies.frozen_vit.modeling_frozen_vit"}
    assert not heavy & set(imported)
    assert not [name for name in imported if name.startswith(("transformers.models", "lerobot_constructskill.sim"))]


HELP = """
import contextlib, importlib, io, sys
sys.argv = ["{command}", "--help"]
help = io.StringIO()
try:
    with contextlib.redirect_stdout(help):
        importlib.import_module("{module}").{function}()
except SystemExit as exit:
    assert not exit.code, exit.code
assert "usage: " in help.getvalue()
assert "torch" not in sys.modules, "--help imports torch"
"""


@pytest.mark.parametrize(("command", "target"), PROJECT["scripts"].items())
def test_help_does_not_wait_for_torch(command: str, target: str) -> None:
    module, function = target.split(":")
    run_python(HELP.format(command=command, module=module, function=function))


def own_files() -> list[str]:
    """Every file that is, or would be, committed."""
    listing = ["git", "ls-files", "--cached", "--others", "--exclude-standard", "-z"]
    done = subprocess.run(listing, capture_output=True, text=True, cwd=REPOSITORY)
    if done.returncode != 0:
        pytest.skip("not a git checkout")
    return [name for name in done.stdout.split("\0") if name and (REPOSITORY / name).is_file()]


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
