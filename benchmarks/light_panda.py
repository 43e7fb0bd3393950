"""Make `sim/panda_light/`: ManiSkill's Panda, its visual meshes decimated. Needs trimesh and fast-simplification.

    python benchmarks/light_panda.py FOLDER

Without a GPU the cost of a frame is the cost of the Panda's 135,000 triangles. At 224 x 224 pixels the mean difference
between pictures of both robots is under 0.5/255.
"""

import sys
from pathlib import Path

import numpy as np
import trimesh

TRIANGLES = 4_000
"""Triangles of the whole robot."""

MIN_TRIANGLES_PER_PART = 12
CREASE_ANGLE = np.radians(40)


def build(folder: Path) -> None:
    """Write the decimated mesh of each link into `folder`."""
    from mani_skill.agents.robots import Panda

    meshes = Path(Panda.urdf_path).parent / "franka_description" / "meshes" / "visual"
    scenes = {path.name: trimesh.load_scene(path) for path in sorted(meshes.glob("*.glb"))}
    total = sum(len(part.faces) for scene in scenes.values() for part in scene.geometry.values())
    for name, scene in scenes.items():
        decimate(scene, TRIANGLES / total)
        scene.export(folder / name)


def decimate(scene: trimesh.Scene, fraction: float) -> None:
    """Reduce every part of `scene` in place to `fraction` of its triangles; colours stay."""
    for name, part in scene.geometry.items():
        material = part.visual.material
        # The files split vertices at every crease; decimation needs the surface in one piece.
        part.merge_vertices(merge_tex=True, merge_norm=True)
        target = max(MIN_TRIANGLES_PER_PART, int(len(part.faces) * fraction))
        few = part.simplify_quadric_decimation(face_count=target)
        light = in_order(trimesh.graph.smooth_shade(few, angle=CREASE_ANGLE))
        light.visual = trimesh.visual.TextureVisuals(material=material)
        scene.geometry[name] = light


def in_order(mesh: trimesh.Trimesh) -> trimesh.Trimesh:
    """The same surface, uncoloured, with faces ordered by their position and vertices ordered by the faces.

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


if __name__ == "__main__":
    build(Path(sys.argv[1]))
