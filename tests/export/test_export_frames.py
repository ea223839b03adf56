"""Files of meshes and of Gaussians have one frame and unit, as other programs read them: that of the scene.

Of SPZ, which has axes of its own, ``tests/export/splats/test_splat_files.py`` has the test.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import trimesh

from coliags_plugin.export.splats.files import write_splats
from coliags_plugin.geometry.meshes.files import write_mesh
from coliags_plugin.geometry.meshes.mesh import TriangleMesh
from tests.export.splats.clouds import random_cloud

#: Corners of a tetrahedron which no turn and no mirroring brings back onto itself. [4, 3]
PLACES = np.array([[1, 2, 30], [5, 2, 31], [1, 9, 33], [2, 3, 45]], np.float32)
COLORS = np.array([[255, 0, 0], [0, 255, 0], [0, 0, 255], [255, 255, 255]], np.uint8)


@pytest.fixture(scope="module")
def folder(tmp_path_factory) -> Path:
    """The tetrahedron as ``mesh.*``, and Gaussians at its corners as ``splats.*``."""
    made = tmp_path_factory.mktemp("frames")
    triangles = np.array([[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]])
    for suffix in ("ply", "obj", "glb"):
        write_mesh(made / f"mesh.{suffix}", TriangleMesh(PLACES, triangles, COLORS))
    cloud = replace(random_cloud(4, 0), means=PLACES)
    for suffix in ("ply", "glb"):
        write_splats(made / f"splats.{suffix}", cloud, suffix)
    return made


def in_order(points: np.ndarray) -> np.ndarray:
    return points[np.argsort(points[:, 2])]


@pytest.mark.parametrize("name", ["mesh.ply", "mesh.obj", "mesh.glb", "splats.ply", "splats.glb"])
def test_trimesh(folder, name):
    scene = trimesh.load_scene(folder / name, skip_materials=True)
    (placed,) = scene.dump()
    np.testing.assert_allclose(in_order(placed.vertices), PLACES, rtol=1e-6)
    if name.startswith("mesh"):
        np.testing.assert_array_equal(placed.visual.vertex_colors[np.argsort(placed.vertices[:, 2]), :3], COLORS)
