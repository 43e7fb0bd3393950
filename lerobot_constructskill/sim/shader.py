"""A shader for colour pictures alone: SAPIEN's `minimal` without what nobody reads, in half the time on a CPU.

The same pictures to the last bit, where nothing is transparent and no environment map is set. SAPIEN's renders
positions and segments beside the colours, samples an empty environment map twice for every fragment, computes how
light of that map would be reflected, and goes over the whole picture once more to put the map behind it.
"""

import hashlib
import shutil
from pathlib import Path

import sapien
from mani_skill.render import ShaderConfig

from lerobot_constructskill.sim.visuals import made_once

PACKS = Path(sapien.__file__).parent / "vulkan_shader"

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


def colour_shader() -> ShaderConfig | None:
    """A shader for cameras of which only `rgb` is asked, or None where SAPIEN's is not the one that `CUTS` knows."""
    source = (PACKS / "minimal" / "gbuffer.frag").read_text(encoding="utf-8")
    if not all(text in source for text in CUTS):
        return None
    for text, replacement in CUTS.items():
        source = source.replace(text, replacement)
    folder = made_once(
        f"shader_{hashlib.sha256(source.encode()).hexdigest()[:16]}", lambda folder: _build(source, folder)
    )
    # ManiSkill sets the format for packs that it knows by name.
    sapien.render.set_picture_format("Color", "r8g8b8a8unorm")
    return ShaderConfig(
        shader_pack=str(folder / "colour"),
        texture_names={"Color": ["rgb"]},
        texture_transforms={"Color": lambda data: {"rgb": data[..., :3]}},
    )


def _build(source: str, folder: Path) -> None:
    shutil.copytree(PACKS / "common", folder / "common")
    (folder / "colour").mkdir()
    for name in ("gbuffer.vert", "shadow.vert"):
        shutil.copy(PACKS / "minimal" / name, folder / "colour")
    (folder / "colour" / "gbuffer.frag").write_text(source, encoding="utf-8")
