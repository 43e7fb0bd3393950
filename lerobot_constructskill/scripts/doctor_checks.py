"""What `constructskill-doctor` makes of a machine: each judgement is a pure function of facts."""

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from enum import StrEnum

from lerobot_constructskill.errors import DISTRIBUTION

DEMO_FRAMES = 5_381
"""What `constructskill-generate fast_shifted_wrist --episodes=50` makes."""

REINSTALL = f"pip install --force-reinstall --no-deps '{DISTRIBUTION}', or the checkout's folder in its place"
DRIVER = "install the driver's Vulkan part (in a container: NVIDIA_DRIVER_CAPABILITIES=all)"
RENDERER = "apt-get install mesa-vulkan-drivers libvulkan1, 24.3 or newer (Debian 12: its backports; Ubuntu 24.04)"

OPENCV = (
    "opencv-python",
    "opencv-python-headless",
    "opencv-contrib-python",
    "opencv-contrib-python-headless",
)
LEROBOTS_OPENCV = "opencv-python-headless"


class Level(StrEnum):
    OK = "OK"
    WARN = "WARN"
    FAIL = "FAIL"


@dataclass(frozen=True)
class Finding:
    """One line of the report; the message of a WARN or FAIL ends in what to do."""

    level: Level
    name: str
    message: str


@dataclass(frozen=True)
class Probe:
    """How a snippet fared in a process of its own: drivers print, and take the whole process with them."""

    ok: bool
    out: str
    reason: str

    @property
    def answer(self) -> str:
        """Its last line: whatever it imports may print before."""
        return (self.out.splitlines() or [""])[-1]


def judge_versions(requirements: Sequence[str], installed: Mapping[str, str]) -> Finding:
    """Compare installed versions with our own metadata; only packages of an extra may be absent."""
    from packaging.requirements import Requirement
    from packaging.utils import canonicalize_name

    wrong, wanted, absent, right = [], [], set(), []
    for requirement in map(Requirement, requirements):
        marker = requirement.marker
        extras = [e for e in ("", "sim", "offline") if marker is None or marker.evaluate({"extra": e})]
        found = installed.get(canonicalize_name(requirement.name))
        if not extras:
            continue
        if found is None and extras[0]:
            absent.add(extras[0])
        elif found is None or not requirement.specifier.contains(found, prereleases=True):
            wrong.append(f"{requirement.name} is {found or 'absent'} (needs {requirement.specifier})")
            wanted.append(f"'{str(requirement).partition(';')[0].strip()}'")
        else:
            right.append(f"{requirement.name} {found}")
    if wrong:
        return Finding(Level.FAIL, "Versions", f"{', '.join(wrong)}; pip install {' '.join(wanted)}.")
    if absent:
        extra = ",".join(sorted(absent))
        return Finding(
            Level.WARN, "Versions", f"the extra [{extra}] is not installed; pip install '{DISTRIBUTION}[{extra}]'."
        )
    return Finding(Level.OK, "Versions", ", ".join(right))


def judge_opencv(installed: Mapping[str, str]) -> Finding:
    """Compare the distributions with LeRobot's choice of one; ManiSkill's requirements bring a second."""
    found = sorted(set(OPENCV) & set(installed))
    if len(found) > 1:
        kept = f"{LEROBOTS_OPENCV}=={installed[LEROBOTS_OPENCV]}" if LEROBOTS_OPENCV in found else LEROBOTS_OPENCV
        remedy = f"pip uninstall -y {' '.join(found)} && pip install {kept}"
        return Finding(Level.WARN, "OpenCV", f"{' and '.join(found)} write into one cv2 folder; {remedy}.")
    if not found:
        return Finding(Level.FAIL, "OpenCV", f"none is installed; pip install {LEROBOTS_OPENCV}.")
    return Finding(Level.OK, "OpenCV", found[0])


def judge_vulkan(probe: Probe, simulator: bool, gpu: bool = False) -> Finding:
    """Judge a line of the device that renders and whether it is a GPU.

    Args:
        simulator: whether SAPIEN is installed.
        gpu: whether this machine has an NVIDIA GPU.
    """
    if not simulator:
        return Finding(
            Level.WARN, "Vulkan", f"not tried, because sapien is not installed; pip install '{DISTRIBUTION}[sim]'."
        )
    if not probe.ok:
        return Finding(
            Level.FAIL,
            "Vulkan",
            f"SAPIEN finds no device to render with ({probe.reason}); {RENDERER}, or on an NVIDIA machine {DRIVER}.",
        )
    device, _, is_gpu = probe.answer.partition("\t")
    if gpu and is_gpu == "False":
        return Finding(Level.WARN, "Vulkan", f"SAPIEN renders on '{device}' and not on the GPU; {DRIVER}.")
    return Finding(Level.OK, "Vulkan", f"SAPIEN renders on '{device}'")


def judge_cuda(probe: Probe, gpu: bool) -> Finding:
    """Judge a line of the GPU that torch found, empty where it found none, and why it found none."""
    if not probe.ok:
        return Finding(Level.FAIL, "CUDA", f"torch does not run ({probe.reason}); fix what fails above first.")
    device, _, reason = probe.answer.partition("\t")
    if device:
        return Finding(Level.OK, "CUDA", f"torch computes on '{device}'")
    if not gpu:
        return Finding(Level.OK, "CUDA", "no NVIDIA GPU: torch computes on the CPU")
    because = f" ({reason.rstrip('.')})" if reason else ""
    return Finding(
        Level.WARN,
        "CUDA",
        f"torch does not find the GPU{because}; install a newer driver, or a torch for the CUDA of this driver.",
    )


def judge_plugin(probe: Probe) -> Finding:
    if probe.ok and probe.answer == "True True":
        return Finding(Level.OK, "Plugin", "LeRobot finds --policy.type=frozen_vit and --env.type=constructskill")
    reason = probe.reason or "its import does not register them"
    return Finding(
        Level.FAIL,
        "Plugin",
        f"LeRobot does not find frozen_vit and constructskill ({reason}); {REINSTALL}.",
    )


def judge_ffmpeg(probe: Probe) -> Finding:
    if probe.ok:
        return Finding(Level.OK, "FFmpeg", "torchcodec loads its shared libraries")
    package = re.search(r"libpython\d\.\d+", probe.reason)
    missing = package[0] if package else "ffmpeg"
    return Finding(
        Level.WARN,
        "FFmpeg",
        f"torchcodec does not find {missing}, so LeRobot decodes with PyAV; apt-get install {missing}.",
    )


def judge_weights(probe: Probe) -> Finding:
    """Judge lines of "backbone<tab>source", the source empty where there is none."""
    if not probe.ok:
        return Finding(
            Level.FAIL, "Weights", f"the search for them failed ({probe.reason}); fix what fails above first."
        )
    sources = dict(line.partition("\t")[::2] for line in probe.out.splitlines() if "\t" in line)
    found = ", ".join(f"{name} ({source})" for name, source in sources.items() if source)
    missing = ", ".join(name for name, source in sources.items() if not source)
    if not missing:
        return Finding(Level.OK, "Weights", found)
    remedy = "let this machine reach the Hub, or give a local copy with --policy.backbone_path."
    if not found:
        return Finding(Level.FAIL, "Weights", f"none for {missing}; {remedy}")
    return Finding(Level.WARN, "Weights", f"{found}, but none for {missing}; {remedy}")


def judge_fetched(name: str, probe: Probe) -> Finding:
    """Judge a line "source<tab>sha256" of weights that were fetched."""
    if not probe.ok:
        reason = probe.reason.partition(": ")[2] or probe.reason
        return Finding(Level.WARN, name, f"{reason.rstrip('.')}.")
    source, sha256 = probe.answer.split("\t")
    return Finding(Level.OK, name, f"{source}, sha256 {sha256[:12]}")


def judge_encoder(probe: Probe) -> Finding:
    """Judge a line of what `auto` means here, what computes it, on what device, and images per second."""
    if not probe.ok:
        return Finding(Level.FAIL, "Encoder", f"does not run ({probe.reason}); fix what fails above first.")
    precision, runtime, device, speed = probe.answer.split()
    expected = (
        f"backbone_precision=auto is {precision} here, {float(speed):.0f} images/s of dinov2_vits14 by {runtime} on "
        f"the {device}: about {DEMO_FRAMES / float(speed) / 60:.0f} min for 50 demonstrations"
    )
    if (runtime, device) == ("torch", "cpu"):
        return Finding(Level.WARN, "Encoder", f"{expected}; pip install '{DISTRIBUTION}[cpu]' to make it faster.")
    return Finding(Level.OK, "Encoder", expected)
