"""The image for vla-evaluation-harness is built and renders, where an engine for containers runs."""

import shutil
import subprocess
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]


def engine() -> str | None:
    """The first that answers: of docker the client alone may be there."""
    for name in ("docker", "podman"):
        if shutil.which(name) and subprocess.run([name, "info"], capture_output=True).returncode == 0:
            return name
    return None


@pytest.mark.nightly
def test_the_image_is_built_and_renders():
    if (name := engine()) is None:
        pytest.skip("no engine for containers runs here")
    subprocess.run(["make", "image", f"ENGINE={name}"], cwd=ROOT, check=True)
    doctor = [name, "run", "--rm", "--entrypoint", "constructskill-doctor", "constructskill"]
    done = subprocess.run(doctor, capture_output=True, text=True)
    assert "OK    Vulkan" in done.stdout, done.stdout + done.stderr
