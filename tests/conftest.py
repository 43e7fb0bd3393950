"""The order of the tests, their garbage, and what several files use: demonstrations, an encoder, a browser.

CONTRIBUTING.md says where a test goes.
"""

import gc
import shutil
import subprocess
from pathlib import Path

import pytest


def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    """Files that take long are dealt out first: a worker that got one last would work on alone."""
    if not hasattr(config, "workerinput"):
        return
    weights = {}
    for item in items:
        weight = 2 * bool(item.get_closest_marker("slow")) + bool(item.get_closest_marker("sim"))
        weights[item.path] = max(weight, weights.get(item.path, 0))
    items.sort(key=lambda item: -weights[item.path])


def pytest_collection_finish() -> None:
    """What the tests import stays: the collector need not look at LeRobot's million objects again and again."""
    gc.collect()
    gc.freeze()


@pytest.fixture(scope="session")
def demonstrations(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Root of three noisy demonstrations with both cameras, made once for all workers; not to be written to."""
    from lerobot_constructskill.artifacts.locks import locked
    from lerobot_constructskill.demos.recorder import GenerateConfig, record

    root = shared(tmp_path_factory) / "demonstrations"
    with locked(root.with_name("demonstrations.lock")):
        if not root.exists():
            record(GenerateConfig("local/demos", str(root), episodes=3, obs_type="pixels_agent_pos"))
    return root


def shared(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of this run's temporary ones that its workers have in common."""
    own = tmp_path_factory.getbasetemp()
    return own.parent if own.name.startswith("popen-") else own


@pytest.fixture
def by_pytorch(monkeypatch):
    """PyTorch encodes: OpenVINO compiles each policy's backbone for three seconds. test_backbones.py compares them."""
    from lerobot_constructskill.policies.frozen_vit import openvino

    monkeypatch.setattr(openvino, "is_installed", lambda: False)


def find_chromium() -> str | None:
    """A Chromium that starts: Ubuntu's apt package is a stand-in that asks for snap."""
    for name in ("chromium", "google-chrome", "chromium-browser"):
        path = shutil.which(name)
        if path and subprocess.run([path, "--version"], capture_output=True).returncode == 0:
            return path
    return None


@pytest.fixture(scope="module")  # while it is open, its event loop runs, which others of a session would meet
def browser():
    playwright, chromium = pytest.importorskip("playwright.sync_api"), find_chromium()
    if chromium is None:
        pytest.skip("no Chromium here; `make nightly` installs it where apt has it")
    with playwright.sync_playwright() as started:
        browser = started.chromium.launch(executable_path=chromium, args=["--no-sandbox"])
        yield browser
        browser.close()
