"""What pictures show: textures, where cameras look, and a shader for colour pictures alone."""

import hashlib
import json
import os
import tempfile
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from functools import lru_cache
from math import copysign, sqrt
from pathlib import Path

import numpy as np
import sapien.render
from mani_skill.envs.scene import ManiSkillScene
from mani_skill.render import ShaderConfig
from PIL import Image

from lerobot_constructskill.errors import MachineError

SHADERS = Path(sapien.__file__).parent / "vulkan_shader"

DIRECTED = sapien.render.RenderDirectionalLightComponent
"""A light like the sun's."""

CUTS = {
    "layout(location = 1) out ivec4 outPositionSegmentation;": "",
    "outPositionSegmentation = ivec4(ivec3(inPosition * 1000), inSegmentation[1]);": "",
    "color += diffuseIBL(diffuseAlbedo, wnormal);": "",
    """color += specularIBL(fresnel, roughness,
                       wnormal,
                       mat3(cameraBuffer.viewMatrixInverse) * camDir);""": "",
    # Where a shader names this table, SAPIEN computes it before the first picture of a process: seconds on a CPU.
    "layout(set = 3, binding = 8) uniform sampler2D samplerBRDFLUT;": "",
    """vec2 envBRDF = texture(samplerBRDFLUT, vec2(roughness, dotNV)).xy;
  return color * (fresnel * envBRDF.x + envBRDF.y);""": "return color;",
    "outColorRaw": "outColor",  # what SAPIEN's second pass, which this pack lacks, writes
}
"""Text of SAPIEN's fragment shader and what stands in its place."""


def cache_folder() -> Path:
    """The folder for files that can be made again: `$XDG_CACHE_HOME` or `~/.cache`, else this user's own in /tmp.

    Raises:
        MachineError: neither can be written.
    """
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


def written_once(name: str, texts: Mapping[str, str]) -> Path:
    """A folder of the cache that holds `texts` as files, by their relative paths. The first use writes it.

    Several processes may ask at once: the folder appears whole, by a rename, or not at all.
    """
    key = hashlib.sha256(json.dumps(texts).encode()).hexdigest()[:16]
    folder = cache_folder() / f"{name}_{key}"
    if not folder.exists():
        with tempfile.TemporaryDirectory(dir=folder.parent) as scratch:
            written = Path(scratch) / "written"
            for path, text in texts.items():
                (written / path).parent.mkdir(parents=True, exist_ok=True)
                (written / path).write_text(text, encoding="utf-8")
            try:
                written.rename(folder)
            except OSError:  # another process was first
                if not folder.exists():
                    raise
    return folder


def colour_shader() -> ShaderConfig | None:
    """A shader for cameras of which only `rgb` is asked, in half the time of SAPIEN's `minimal` on a CPU.

    The pictures are the same to the last bit where nothing is transparent and no environment map is set. SAPIEN's
    shader also renders positions and segments, samples an empty environment map twice for every fragment, computes
    the light that the map would reflect, and puts the map behind the picture in a second pass.

    Returns:
        None where SAPIEN's shader is not the one that `CUTS` knows.
    """
    minimal, common = SHADERS / "minimal", SHADERS / "common"
    source = (minimal / "gbuffer.frag").read_text(encoding="utf-8")
    if not all(text in source for text in CUTS):
        return None
    for text, replacement in CUTS.items():
        source = source.replace(text, replacement)
    texts = {f"common/{path.name}": path.read_text(encoding="utf-8") for path in sorted(common.iterdir())}
    for name in ("gbuffer.vert", "shadow.vert"):
        texts[f"colour/{name}"] = (minimal / name).read_text(encoding="utf-8")
    folder = written_once("shader", texts | {"colour/gbuffer.frag": source})
    # ManiSkill sets the format for packs that it knows by name.
    sapien.render.set_picture_format("Color", "r8g8b8a8unorm")
    return ShaderConfig(
        shader_pack=str(folder / "colour"),
        texture_names={"Color": ["rgb"]},
        texture_transforms={"Color": lambda data: {"rgb": data[..., :3]}},
    )


def looking_from(eye: Sequence[float], target: Sequence[float]) -> sapien.Pose:
    """The pose of an upright camera at `eye` that looks along its x axis at `target`, both in metres.

    The camera may look neither straight up nor straight down. ManiSkill's `look_at` takes roots in float32 with MKL,
    which is off by a bit on some processors and then shows in a few pixels. Here every number is rounded to float32
    once.
    """
    x, y, z = (float(b) - float(a) for a, b in zip(eye, target, strict=True))
    level = sqrt(x * x + y * y)
    yaw_cos, yaw_sin = half_angle(x / level, y)
    pitch_cos, pitch_sin = half_angle(level / sqrt(x * x + y * y + z * z), -z)
    q = (yaw_cos * pitch_cos, -yaw_sin * pitch_sin, yaw_cos * pitch_sin, yaw_sin * pitch_cos)
    return sapien.Pose(p=eye, q=q)


@contextmanager
def shining_sun(scene: ManiSkillScene) -> Iterator[None]:
    """For as long as it lasts, one light casts shadows in place of the lights that do not but for the first.

    A light that casts shadows when the scene is made would do so in every picture, at several times its cost.
    """
    (sub_scene, *_) = scene.sub_scenes
    lights = [one for entity in sub_scene.entities for one in entity.components if isinstance(one, DIRECTED)][1:]
    colours = [light.color for light in lights]
    sun, entity = DIRECTED(), sapien.Entity()
    sun.color, sun.shadow, sun.shadow_map_size = [0.6, 0.6, 0.6], True, 2048
    sun.shadow_half_size, sun.shadow_near, sun.shadow_far = 1.2, -3.0, 3.0
    entity.add_component(sun)
    sun.pose = looking_from((-0.2, 0.0, 0.0), (0.15, 0.25, -1.0))
    for light in lights:
        light.color = [0.0, 0.0, 0.0]
    sub_scene.add_entity(entity)
    try:
        yield
    finally:
        sub_scene.remove_entity(entity)
        for light, colour in zip(lights, colours, strict=True):
            light.color = colour


def half_angle(cosine: float, side: float) -> tuple[float, float]:
    """Cosine and sine of half an angle, of which the cosine and the sine's sign are known."""
    return sqrt((1 + cosine) / 2), copysign(sqrt((1 - cosine) / 2), side)


def textured(image: np.ndarray, roughness: float = 0.9) -> sapien.render.RenderMaterial:
    """A matt material that shows `image`, an (H, W, 3) uint8 array."""
    rgba = np.concatenate([image, np.full((*image.shape[:2], 1), 255, np.uint8)], axis=-1)
    material = sapien.render.RenderMaterial(roughness=roughness, metallic=0.0, specular=0.1)
    material.base_color_texture = sapien.render.RenderTexture2D(rgba, "R8G8B8A8Unorm", mipmap_levels=4, srgb=True)
    return material


@lru_cache(maxsize=32)  # every episode has its scene made anew
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
