"""What the scene looks like: the Panda's light-weight visual meshes and the procedural textures.

Without a GPU a frame's cost is the Panda's 135,000 triangles, so the meshes are decimated once and cached.
Collision meshes are the original files, and so is the SRDF, which lists the links whose contact is ignored and which
SAPIEN looks for beside a URDF: physics does not know which robot is drawn.
"""

import functools
import hashlib
import os
import shutil
import tempfile
import xml.etree.ElementTree as ET
from collections.abc import Callable
from pathlib import Path

import numpy as np
import sapien.render
import trimesh
from mani_skill.agents.registration import register_agent
from mani_skill.agents.robots import Panda
from PIL import Image

from lerobot_constructskill.errors import MachineError
from lerobot_constructskill.sim.control import QuickMimicController, QuickPoseController

LIGHT_TRIANGLES = 4_000
"""Triangles of the whole light robot; at 224 x 224 pixels the mean difference is under 0.5/255."""

_MIN_TRIANGLES_PER_PART = 12
_CREASE_ANGLE = np.radians(40)


def cache_folder() -> Path:
    """Folder for files that can be made again: `$XDG_CACHE_HOME` or `~/.cache`, else one of this user's in /tmp."""
    home = os.environ.get("XDG_CACHE_HOME") or os.path.expanduser("~/.cache")
    for folder in (Path(home) / "constructskill", Path(tempfile.gettempdir()) / f"constructskill-{os.getuid()}"):
        try:
            folder.mkdir(parents=True, exist_ok=True)
            tempfile.TemporaryFile(dir=folder).close()
        except OSError:
            continue
        return folder
    raise MachineError(
        "Neither ~/.cache nor the temporary folder can be written; set XDG_CACHE_HOME to a folder that can."
    )


def made_once(name: str, build: Callable[[Path], None]) -> Path:
    """The folder called `name` in the cache, which `build` makes on first use.

    Safe for several processes at once: the folder appears whole, by a rename, or not at all.
    """
    folder = cache_folder() / name
    if not folder.exists():
        with tempfile.TemporaryDirectory(dir=folder.parent) as scratch:
            built = Path(scratch) / "built"
            built.mkdir()
            build(built)
            try:
                built.rename(folder)
            except OSError:  # another process was first
                if not folder.exists():
                    raise
    return folder


def light_panda_urdf() -> str:
    """Path of a Panda URDF whose visual meshes have `LIGHT_TRIANGLES` triangles; made on first use."""
    source = Path(Panda.urdf_path)
    facts = f"{LIGHT_TRIANGLES} {_CREASE_ANGLE} in order {source}".encode()
    files = [source.read_bytes(), source.with_suffix(".srdf").read_bytes()]
    key = hashlib.sha256(b"".join([facts, *files])).hexdigest()[:16]
    return str(made_once(f"panda_light_{key}", lambda folder: _build_light_panda(source, folder)) / source.name)


def _build_light_panda(source: Path, folder: Path) -> None:
    tree = ET.parse(source)
    visuals = [mesh for visual in tree.iter("visual") for mesh in visual.iter("mesh")]
    names = sorted({mesh.attrib["filename"] for mesh in visuals})
    scenes = {name: trimesh.load_scene(source.parent / name) for name in names}
    total = sum(len(part.faces) for scene in scenes.values() for part in scene.geometry.values())
    for name, scene in scenes.items():
        _decimate(scene, LIGHT_TRIANGLES / total)
        scene.export(folder / Path(name).name)
    for mesh in tree.iter("mesh"):
        name = mesh.attrib["filename"]
        light = mesh in visuals
        mesh.attrib["filename"] = str(Path(name).name if light else source.parent / name)
    tree.write(folder / source.name)
    shutil.copy(source.with_suffix(".srdf"), folder)


def _decimate(scene: trimesh.Scene, fraction: float) -> None:
    """Reduce every part of `scene` in place to `fraction` of its triangles; colours stay."""
    for name, part in scene.geometry.items():
        material = part.visual.material
        # The files split vertices at every crease; decimation needs the surface in one piece.
        part.merge_vertices(merge_tex=True, merge_norm=True)
        target = max(_MIN_TRIANGLES_PER_PART, int(len(part.faces) * fraction))
        few = part.simplify_quadric_decimation(face_count=target)
        light = in_order(trimesh.graph.smooth_shade(few, angle=_CREASE_ANGLE))
        light.visual = trimesh.visual.TextureVisuals(material=material)
        scene.geometry[name] = light


def in_order(mesh: trimesh.Trimesh) -> trimesh.Trimesh:
    """The same surface, uncoloured, with its faces in the order of where they are, and vertices as faces need them.

    NumPy's sorts are not stable, and each instruction set has its own: trimesh leaves the same triangles in another
    order with AVX2 and without, which pictures show.
    """
    _, place = np.unique(mesh.vertices, axis=0, return_inverse=True)
    places = place[mesh.faces]
    turns = (np.arange(3) + places.argmin(axis=1)[:, None]) % 3
    faces, places = (np.take_along_axis(corners, turns, axis=1) for corners in (mesh.faces, places))
    corners = faces[np.lexsort(places.T[::-1])].reshape(-1).tolist()
    number = {vertex: new for new, vertex in enumerate(dict.fromkeys(corners))}
    renumbered = np.array([number[vertex] for vertex in corners]).reshape(-1, 3)
    return trimesh.Trimesh(mesh.vertices[list(number)], renumbered, process=False)


@register_agent()
class QuickPanda(Panda):
    """ManiSkill's Panda, whose `pd_ee_delta_pose` comes to the same numbers sooner on a CPU."""

    uid = "constructskill_panda"

    @property
    def _controller_configs(self):
        configs = super()._controller_configs
        configs["pd_ee_delta_pose"]["arm"].controller_cls = QuickPoseController
        configs["pd_ee_delta_pose"]["gripper"].controller_cls = QuickMimicController
        return configs


@register_agent()
class LightPanda(QuickPanda):
    """The same, drawn with a few thousand triangles. Same links, collisions and controllers."""

    uid = "constructskill_panda_light"

    @property
    def urdf_path(self) -> str:
        return light_panda_urdf()


def textured(image: np.ndarray, roughness: float = 0.9) -> sapien.render.RenderMaterial:
    """A matt material that shows `image`, an (H, W, 3) uint8 array."""
    rgba = np.concatenate([image, np.full((*image.shape[:2], 1), 255, np.uint8)], axis=-1)
    material = sapien.render.RenderMaterial(roughness=roughness, metallic=0.0, specular=0.1)
    material.base_color_texture = sapien.render.RenderTexture2D(rgba, "R8G8B8A8Unorm", mipmap_levels=4, srgb=True)
    return material


@functools.lru_cache(maxsize=32)  # every episode has its scene made anew
def mottled(colour: tuple[int, int, int], contrast: float, size: int = 256, seed: int = 0) -> np.ndarray:
    """A mineral surface of mean `colour`: soft blotches and fine grain, (size, size, 3) uint8, not to be written to.

    Args:
        colour: mean RGB, 0 to 255.
        contrast: standard deviation of the brightness, as a fraction of the colour.
    """
    rng = np.random.default_rng(seed)
    brightness = np.zeros((size, size))
    for cells in (8, 32, 128):
        coarse = Image.fromarray(rng.standard_normal((cells, cells)).astype(np.float32))
        brightness += np.asarray(coarse.resize((size, size), Image.Resampling.BICUBIC))
    brightness *= contrast / brightness.std()
    surface = np.clip(np.array(colour) * (1 + brightness[..., None]), 0, 255).astype(np.uint8)
    surface.setflags(write=False)
    return surface


def perforated(image: np.ndarray, rows: int, columns: int, radius: float) -> np.ndarray:
    """`image` with a grid of dark round holes, as on the bed face of a brick.

    Args:
        radius: of a hole, as a fraction of the spacing between holes.
    """
    height, width = image.shape[:2]
    y = (np.arange(height)[:, None] + 0.5) * rows / height % 1 - 0.5
    x = (np.arange(width)[None, :] + 0.5) * columns / width % 1 - 0.5
    holes = np.hypot(x, y) < radius
    return np.where(holes[..., None], image // 4, image)
