"""`constructskill-doctor`: say what is wrong with a machine; one line for each check."""

import shutil
import subprocess
import sys
from collections.abc import Callable, Iterable
from importlib import metadata

from lerobot_constructskill.errors import DISTRIBUTION, plural
from lerobot_constructskill.scripts.console import EPILOG, Parser, edge, say
from lerobot_constructskill.scripts.doctor_checks import (
    Finding,
    Level,
    Probe,
    judge_cuda,
    judge_encoder,
    judge_fetched,
    judge_ffmpeg,
    judge_opencv,
    judge_plugin,
    judge_versions,
    judge_vulkan,
    judge_weights,
)

PROBE_TIMEOUT_S = 600  # importing LeRobot took 3 minutes on one core of a busy machine

# The choice of `best_render_backend`, without ManiSkill.
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
print(device.name, device.is_cuda(), sep="\\t")
"""

# torch says by a warning why it cannot use a GPU, such as a driver that is older than its CUDA.
CUDA = """
import warnings, torch
with warnings.catch_warnings(record=True) as said:
    warnings.simplefilter("always")
    name = torch.cuda.get_device_name() if torch.cuda.is_available() else ""
print(name, *(" ".join(str(one.message).split()) for one in said[:1]), sep="\\t")
"""

REGISTER = """
from lerobot_constructskill.lerobot_internals import register_third_party_plugins
register_third_party_plugins()
from lerobot.configs import PreTrainedConfig
from lerobot.envs import EnvConfig
print("frozen_vit" in PreTrainedConfig.get_known_choices(), "constructskill" in EnvConfig.get_known_choices())
"""

# torchcodec's own complaint names every FFmpeg that is not here, and not the Python library that may be missing.
DECODE = """
import ctypes, sysconfig
try:
    from torchcodec.decoders import VideoDecoder
except RuntimeError:
    ctypes.CDLL(f"libpython{sysconfig.get_python_version()}.so.1.0")
    raise
"""

# Asks whether the weights are there, not for the weights: those of all backbones together are 0.5 GB.
FIND_WEIGHTS = """
from lerobot_constructskill.policies.frozen_vit.backbones import BACKBONES
from lerobot_constructskill.policies.frozen_vit.weights import find_source
for backbone in BACKBONES.values():
    print(backbone.name, find_source(backbone) or "", sep="\\t")
"""


FETCH_WEIGHTS = """
from lerobot_constructskill.policies.frozen_vit.backbones import get_backbone
from lerobot_constructskill.policies.frozen_vit.weights import load_weights, state_sha256
state, source = load_weights(get_backbone("{name}"))
print(source, state_sha256(state), sep="\\t")
"""

# Random weights take as long as trained ones.
ENCODE = """
import time, torch
from lerobot_constructskill.policies.frozen_vit.backbones import get_backbone
from lerobot_constructskill.policies.frozen_vit.encoder import FrozenEncoder
from lerobot_constructskill.policies.frozen_vit.precision import native_precision
device = "cuda" if torch.cuda.is_available() else "cpu"
encoder = FrozenEncoder(get_backbone("dinov2_vits14"), native_precision(device)).to(device)
images = torch.rand(16, 3, 224, 224)
for _ in range(2):
    start = time.perf_counter()
    encoder(images.to(device)).cpu()
print(encoder.precision, encoder.runtime, device, 16 / (time.perf_counter() - start))
"""


def probe(code: str) -> Probe:
    """Run a snippet in a fresh Python and keep its output, and the last line it complained with."""
    try:
        done = subprocess.run(
            [sys.executable, "-c", code], capture_output=True, text=True, timeout=PROBE_TIMEOUT_S, check=False
        )
    except subprocess.TimeoutExpired:
        return Probe(False, "", f"no answer within {PROBE_TIMEOUT_S} s; is this machine busy?")
    complaint = (done.stderr.strip().splitlines() or [""])[-1]
    if done.returncode < 0:
        complaint = f"the process died of signal {-done.returncode}"
    return Probe(done.returncode == 0, done.stdout.strip(" \n"), complaint)  # a tab at the end says something


def installed_versions() -> dict[str, str]:
    """Versions of the installed distributions under their raw names."""
    return {d.metadata["Name"]: d.version for d in metadata.distributions() if d.metadata["Name"]}


def has_gpu() -> bool:
    if shutil.which("nvidia-smi") is None:
        return False
    return subprocess.run(["nvidia-smi", "-L"], capture_output=True, check=False).returncode == 0


def check_versions() -> Finding:
    from packaging.utils import canonicalize_name

    installed = installed_versions()
    requirements = metadata.requires(DISTRIBUTION) if DISTRIBUTION in installed else None
    return judge_versions(requirements or [], {canonicalize_name(n): v for n, v in installed.items()})


def check_vulkan() -> Finding:
    if "sapien" not in installed_versions():
        return judge_vulkan(Probe(False, "", ""), simulator=False)
    return judge_vulkan(probe(RENDER), simulator=True, gpu=has_gpu())


CHECKS: tuple[Callable[[], Finding], ...] = (
    check_versions,
    lambda: judge_opencv(installed_versions()),
    check_vulkan,
    lambda: judge_cuda(probe(CUDA), has_gpu()),
    lambda: judge_ffmpeg(probe(DECODE)),
    lambda: judge_plugin(probe(REGISTER)),
    lambda: judge_weights(probe(FIND_WEIGHTS)),
    lambda: judge_encoder(probe(ENCODE)),
)


def fetching() -> list[Callable[[], Finding]]:
    """A check for each backbone that fetches its weights, into the Hub's cache where that is their source."""
    from lerobot_constructskill.policies.frozen_vit.backbones import BACKBONES

    return [lambda name=name: judge_fetched(name, probe(FETCH_WEIGHTS.format(name=name))) for name in BACKBONES]


def diagnose(checks: Iterable[Callable[[], Finding]] = CHECKS) -> int:
    """Run the checks, print each finding as it comes, and return the exit status: 1 if one failed or none passed."""
    levels = []
    for check in checks:
        finding = check()
        levels.append(finding.level)
        say(f"{finding.level:<4}  {finding.name:<17}  {finding.message}")
    failed, warned = levels.count(Level.FAIL), levels.count(Level.WARN)
    say(f"{plural(len(levels), 'check')}, {failed} failed, {warned} warned.")
    return int(failed > 0 or Level.OK not in levels)


def main() -> None:
    parser = Parser(
        prog="constructskill-doctor",
        description="Check packages, Vulkan, CUDA, FFmpeg, the LeRobot plugin, the pretrained weights "
        "and the encoder's speed on this machine (about a minute). Exit status 1 if one fails or none passes.",
        epilog=EPILOG,
    )
    parser.add_argument(
        "--weights", action="store_true", help="fetch the weights of every backbone instead, check and name them"
    )
    with edge():
        sys.exit(diagnose(fetching() if parser.parse_args().weights else CHECKS))


if __name__ == "__main__":
    main()
