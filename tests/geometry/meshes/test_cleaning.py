"""Connected parts and their removal."""

from __future__ import annotations

import numpy as np

from coliags_plugin.geometry.meshes.cleaning import parts_of, without_small_parts
from coliags_plugin.geometry.meshes.mesh import TriangleMesh


def squares(*edges: float) -> TriangleMesh:
    """A square of two triangles for each length of an edge, side by side, not connected."""
    corners = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]], np.float32)
    vertices = [corners * edge + np.float32([100 * place, 0, 0]) for place, edge in enumerate(edges)]
    triangles = [np.array([[0, 1, 2], [0, 2, 3]]) + 4 * place for place in range(len(edges))]
    return TriangleMesh(np.concatenate(vertices), np.concatenate(triangles))


def test_parts_are_what_is_connected():
    assert parts_of(squares(1, 2, 3)).tolist() == [0, 0, 1, 1, 2, 2]


def test_small_parts_are_removed_by_area():
    mesh = squares(1, 10, 2)
    assert np.allclose(without_small_parts(mesh, 0.02).areas, [50, 50, 2, 2])
    assert len(without_small_parts(mesh, 0.05)) == 2
    assert len(without_small_parts(mesh, 0.0)) == 6


def test_an_empty_mesh_stays_empty():
    assert len(without_small_parts(squares(1).part(np.zeros(2, bool)), 0.5)) == 0
