"""The Vulkan drivers that SAPIEN sees. Standard library only: SAPIEN decides when it is imported."""

import os
import shutil
from importlib.util import find_spec
from pathlib import Path

FOLDERS = (Path("/etc/vulkan/icd.d"), Path("/usr/local/share/vulkan/icd.d"), Path("/usr/share/vulkan/icd.d"))
"""Where Vulkan's loader looks for drivers."""

CHOICES = ("VK_ICD_FILENAMES", "VK_DRIVER_FILES")
"""Variables by which a user chooses drivers."""


def show_all_drivers() -> None:
    """Name every driver to Vulkan's loader where SAPIEN would name NVIDIA's alone and so hide Mesa's.

    Call it before the first import of SAPIEN, which does so where an NVIDIA GPU has its driver file not in
    /usr/share/vulkan/icd.d. Container toolkits put it into /etc/vulkan/icd.d. What the user has chosen stays.
    """
    is_usual = (FOLDERS[-1] / "nvidia_icd.json").is_file()
    if is_usual or any(map(os.environ.get, CHOICES)) or shutil.which("nvidia-smi") is None:
        return
    found = [file for folder in FOLDERS for file in sorted(folder.glob("*.json"))]
    if not any("nvidia" in file.name for file in found) and (sapien := find_spec("sapien")):
        found.append(Path(sapien.origin).parent / "vulkan_library" / "nvidia_icd.json")
    if found:
        os.environ["VK_ICD_FILENAMES"] = os.pathsep.join(map(str, found))
