"""`constructskill-doctor`: say what is wrong with a machine; one line for each check."""

import subprocess
import sys
from collections.abc import Iterable
from dataclasses import dataclass
from importlib import metadata

from lerobot_constructskill.errors import DISTRIBUTION, InputError, plural
from lerobot_constructskill.scripts.console import EPILOG, Parser, edge, say

OK, WARN, FAIL = "OK", "WARN", "FAIL"

PROBE_TIMEOUT_S = 600
"""Importing LeRobot took 3 minutes on one core of a busy machine."""


@dataclass(frozen=True)
class Probe:
    """A question to this machine.

    Args:
        name: what the line of its answer begins with.
        code: prints the answer in a Python of its own, because a driver can end the whole process. What it raises is
            the complaint.
        remedy: what to do about a complaint.
        level: how bad a complaint is, `WARN` or `FAIL`.
    """

    name: str
    code: str
    remedy: str
    level: str = FAIL


VERSIONS = f"""
from importlib.metadata import requires
from lerobot_constructskill.scripts.doctor import compare_versions
print(compare_versions(requires("{DISTRIBUTION}")))
"""

# The device is that of `best_render_backend`, without ManiSkill.
RENDER = """
import lerobot_constructskill.sim  # names Vulkan's drivers before SAPIEN does
import sapien
try:
    device = sapien.Device("cuda")
except RuntimeError:
    device = None
if device is None or not device.can_render():
    device = sapien.Device("cpu")
sapien.render.RenderSystem(device)
print(f"SAPIEN renders on '{device.name}'")
"""

# torchcodec's own complaint names every FFmpeg that is not here, and not the Python library that may be missing.
DECODE = """
import ctypes, sysconfig
try:
    from torchcodec.decoders import VideoDecoder
except RuntimeError:
    ctypes.CDLL(f"libpython{sysconfig.get_python_version()}.so.1.0")
    raise
print("torchcodec loads its shared libraries")
"""

REGISTER = """
from lerobot_constructskill.lerobot_internals import register_third_party_plugins
register_third_party_plugins()
from lerobot.configs import PreTrainedConfig
from lerobot.envs import EnvConfig
PreTrainedConfig.get_choice_class("frozen_vit"), EnvConfig.get_choice_class("constructskill")
print("LeRobot finds --policy.type=frozen_vit and --env.type=constructskill")
"""

# Asks whether the weights are there, not for the weights: those of all backbones together are 0.5 GB.
FIND_WEIGHTS = """
from lerobot_constructskill.policies.frozen_vit.backbones import BACKBONES
from lerobot_constructskill.policies.frozen_vit.weights import find_source
sources = {name: find_source(backbone) for name, backbone in BACKBONES.items()}
found = ", ".join(f"{name} ({source})" for name, source in sources.items() if source)
missing = ", ".join(name for name, source in sources.items() if not source)
assert not missing, f"there are none of {missing}, only of {found}"
print(found)
"""

FETCH_WEIGHTS = """
from lerobot_constructskill.policies.frozen_vit.backbones import get_backbone
from lerobot_constructskill.policies.frozen_vit.weights import load_weights, state_sha256
state, source = load_weights(get_backbone("{name}"))
print(f"{{source}}, sha256 {{state_sha256(state)[:12]}}")
"""

# Random weights take as long as trained ones. Fifty demonstrations of precise/brick_to_bin_shifted have 5,381 frames.
ENCODE = """
import time, torch
from lerobot_constructskill.policies.frozen_vit.backbones import get_backbone
from lerobot_constructskill.policies.frozen_vit.encoder import FrozenEncoder
from lerobot_constructskill.policies.frozen_vit.precision import native_precision
device = "cuda" if torch.cuda.is_available() else "cpu"
encoder = FrozenEncoder(get_backbone("efficientnet_lite0_fine"), native_precision(device)).to(device)
images = torch.rand(16, 3, 224, 224)
for _ in range(2):
    start = time.perf_counter()
    encoder(images.to(device)).cpu()
    speed = 16 / (time.perf_counter() - start)
print(
    f"backbone_precision=auto is {encoder.precision} here, {speed:.0f} images/s of efficientnet_lite0_fine by "
    f"{encoder.runtime} on the {device}: about {5_381 / speed:.0f} s for 50 demonstrations"
)
"""

REINSTALL = f"uv pip install --force-reinstall '{DISTRIBUTION}', or the checkout's folder in its place"
WEIGHTS = "let this machine reach the Hub, or give a local copy with --policy.backbone_path"
PROBES = (
    Probe("Versions", VERSIONS, REINSTALL),
    Probe(
        "Vulkan",
        RENDER,
        f"uv pip install '{DISTRIBUTION}[sim]', and apt-get install mesa-vulkan-drivers libvulkan1, 24.3 or newer "
        "(Debian 12: its backports; Ubuntu 24.04), or on an NVIDIA machine the driver's Vulkan part (in a container: "
        "NVIDIA_DRIVER_CAPABILITIES=all)",
    ),
    Probe(
        "FFmpeg", DECODE, "LeRobot decodes with PyAV; apt-get install ffmpeg, or the libpython that is not found", WARN
    ),
    Probe("Plugin", REGISTER, REINSTALL),
    Probe("Weights", FIND_WEIGHTS, WEIGHTS, WARN),
    Probe("Encoder", ENCODE, "fix what fails above first"),
)


def fetching() -> list[Probe]:
    """A probe for each backbone that fetches its weights, into the Hub's cache where that is their source."""
    from lerobot_constructskill.policies.frozen_vit.backbones import BACKBONES

    return [Probe(name, FETCH_WEIGHTS.format(name=name), WEIGHTS, WARN) for name in BACKBONES]


def answer(probe: Probe) -> tuple[str, str]:
    """Run a probe and return the level of its answer, and the answer: the last line that it printed or complained."""
    command = [sys.executable, "-c", probe.code]
    try:
        done = subprocess.run(command, capture_output=True, text=True, timeout=PROBE_TIMEOUT_S, check=False)
    except subprocess.TimeoutExpired:
        return probe.level, f"no answer within {PROBE_TIMEOUT_S} s; is this machine busy?"
    if done.returncode == 0:
        return OK, done.stdout.strip().splitlines()[-1]
    died = [f"the process died of signal {-done.returncode}"]
    said = done.stderr.strip().splitlines() if done.returncode > 0 else died
    complaint = said[-1].partition(": ")[2] or said[-1]  # without the name of the exception
    return probe.level, f"{complaint.rstrip('.')}; {probe.remedy}."


def compare_versions(requirements: Iterable[str]) -> str:
    """The installed versions of the packages that requirements name; a package of an extra may be absent.

    Raises:
        InputError: a package is absent, or its version is out of bounds.
    """
    from packaging.requirements import Requirement
    from packaging.utils import canonicalize_name

    installed = {canonicalize_name(one.name): one.version for one in metadata.distributions() if one.name}
    found = [(one, installed.get(canonicalize_name(one.name))) for one in map(Requirement, requirements)]
    needed = [pair for pair in found if pair[1] or not pair[0].marker or pair[0].marker.evaluate({"extra": ""})]
    wrong = [(one, version) for one, version in needed if not (version and one.specifier.contains(version, True))]
    if wrong:
        told = ", ".join(f"{one.name} is {version or 'absent'} (needs {one.specifier})" for one, version in wrong)
        raise InputError(f"{told}.")
    return ", ".join(dict.fromkeys(f"{one.name} {version}" for one, version in needed))


def diagnose(probes: Iterable[Probe]) -> int:
    """Run the probes, print each answer as it comes, and return the exit status: 1 if one failed or none passed."""
    levels = []
    for name, (level, said) in ((probe.name, answer(probe)) for probe in probes):
        levels.append(level)
        say(f"{level:<4}  {name:<17}  {said}")
    say(f"{plural(len(levels), 'check')}, {levels.count(FAIL)} failed, {levels.count(WARN)} warned.")
    return int(FAIL in levels or OK not in levels)


def main() -> None:
    parser = Parser(
        prog="constructskill-doctor",
        description="Check packages, Vulkan, FFmpeg, the LeRobot plugin, the pretrained weights and the encoder's "
        "speed on this machine (about a minute). Exit status 1 if one fails or none passes.",
        epilog=EPILOG,
    )
    parser.add_argument(
        "--weights", action="store_true", help="fetch the weights of every backbone instead, check and name them"
    )
    with edge():
        sys.exit(diagnose(fetching() if parser.parse_args().weights else PROBES))
