"""What decides pictures is the same on every processor: the light robot's meshes, and where cameras look."""

import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import trimesh
from mani_skill.utils.sapien_utils import look_at

from lerobot_constructskill.sim.poses import looking_from
from lerobot_constructskill.sim.visuals import in_order

pytestmark = pytest.mark.sim

NEWER = "AVX2 FMA3 AVX512F AVX512CD AVX512_SKX AVX512_CLX AVX512_CNL AVX512_ICL AVX512_SPR"
"""Instruction sets that NumPy sorts with in ways of their own, where a CPU has them."""

BUILD = "from lerobot_constructskill.sim.visuals import light_panda_urdf; light_panda_urdf()"


def build(cache: Path, without: str) -> dict[str, np.ndarray]:
    """The light robot's triangles, as a process makes them whose NumPy leaves out some instruction sets."""
    env = os.environ | {"NPY_DISABLE_CPU_FEATURES": without, "XDG_CACHE_HOME": str(cache)}
    subprocess.run([sys.executable, "-c", BUILD], env=env, check=True, capture_output=True)
    scenes = {path.name: trimesh.load_scene(path) for path in sorted(cache.rglob("*.glb"))}
    return {f"{name}/{key}": part.triangles for name, scene in scenes.items() for key, part in scene.geometry.items()}


def test_the_light_robot_does_not_depend_on_instruction_sets(tmp_path):
    here, elsewhere = build(tmp_path / "here", ""), build(tmp_path / "elsewhere", NEWER)
    assert here.keys() == elsewhere.keys() and sum(map(len, here.values())) > 1000
    for part, triangles in here.items():
        np.testing.assert_array_equal(triangles, elsewhere[part], err_msg=part)


@pytest.mark.parametrize("seed", range(5))
def test_the_order_of_a_mesh_follows_from_its_shape_alone(seed):
    mesh, rng = trimesh.creation.icosphere(subdivisions=2), np.random.default_rng(seed)
    number = rng.permutation(len(mesh.vertices))
    vertices, faces = np.empty_like(mesh.vertices), number[rng.permutation(mesh.faces)]
    vertices[number] = mesh.vertices
    turned = np.array([np.roll(face, rng.integers(3)) for face in faces])
    shuffled = in_order(trimesh.Trimesh(vertices, turned, process=False))
    ordered = in_order(mesh)
    np.testing.assert_array_equal(shuffled.vertices, ordered.vertices)
    np.testing.assert_array_equal(shuffled.faces, ordered.faces)
    assert ordered.is_watertight and np.isclose(ordered.volume, mesh.volume)


@pytest.mark.parametrize("seed", range(20))
def test_cameras_look_where_maniskills_would(seed):
    eye, target = np.random.default_rng(seed).uniform(-2, 2, (2, 3))
    ours, theirs = looking_from(eye, target), look_at(eye.tolist(), target.tolist()).sp
    np.testing.assert_allclose(ours.p, theirs.p, atol=1e-6)
    np.testing.assert_allclose(ours.q * np.sign(ours.q @ theirs.q), theirs.q, atol=1e-6)
