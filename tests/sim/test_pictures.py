"""What decides pictures is the same on every processor: the light robot's meshes, and where cameras look."""

import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import trimesh
from mani_skill.utils.sapien_utils import look_at

from lerobot_constructskill.sim.robot import LIGHT_MESHES
from lerobot_constructskill.sim.visuals import looking_from

BENCHMARKS = Path(__file__).parents[2] / "benchmarks"
sys.path.insert(0, str(BENCHMARKS))
from light_panda import in_order  # noqa: E402

pytestmark = pytest.mark.sim

NEWER = "AVX2 FMA3 AVX512F AVX512CD AVX512_SKX AVX512_CLX AVX512_CNL AVX512_ICL AVX512_SPR"
"""Instruction sets that NumPy sorts with in ways of their own, where a CPU has them."""


def triangles(folder: Path) -> dict[str, np.ndarray]:
    """The triangles of each part of the meshes in `folder`."""
    scenes = {path.name: trimesh.load_scene(path) for path in sorted(folder.glob("*.glb"))}
    return {f"{name}/{key}": part.triangles for name, scene in scenes.items() for key, part in scene.geometry.items()}


@pytest.mark.parametrize("without", ["", NEWER])
def test_the_light_robots_meshes_are_what_its_script_makes_on_any_processor(without, tmp_path):
    env = os.environ | {"NPY_DISABLE_CPU_FEATURES": without}
    command = [sys.executable, BENCHMARKS / "light_panda.py", tmp_path]
    subprocess.run(command, env=env, check=True, capture_output=True)
    made, shipped = triangles(tmp_path), triangles(LIGHT_MESHES)
    assert made.keys() == shipped.keys() and sum(map(len, shipped.values())) > 1000
    for part, expected in shipped.items():
        np.testing.assert_array_equal(made[part], expected, err_msg=part)


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
