"""Measures of triangle meshes against closed forms."""

from __future__ import annotations

import numpy as np
import pytest

from coliags_plugin.geometry.meshes.mesh import TriangleMesh


@pytest.fixture
def two_triangles():
    vertices = np.array([[0, 0, 0], [2, 0, 0], [0, 3, 0], [0, 0, 4], [9, 9, 9]], np.float32)
    colors = np.arange(15, dtype=np.uint8).reshape(5, 3)
    return TriangleMesh(vertices, np.array([[0, 1, 2], [0, 3, 1]]), colors)


def test_areas_normals_and_centers(two_triangles):
    assert two_triangles.areas == pytest.approx([3.0, 4.0])
    assert two_triangles.normals == pytest.approx(np.array([[0, 0, 1], [0, 1, 0]]))
    assert two_triangles.centers == pytest.approx(np.array([[2 / 3, 1, 0], [2 / 3, 0, 4 / 3]]))
    flat = TriangleMesh(np.array([[0.0, 0, 0], [1, 1, 1], [2, 2, 2]]), np.array([[0, 1, 2]]))
    assert flat.areas == pytest.approx([0.0]) and flat.normals == pytest.approx(np.zeros((1, 3)))


def test_the_border_is_the_edges_of_one_triangle(two_triangles):
    assert sorted(map(tuple, two_triangles.border)) == [(0, 3), (1, 2), (2, 0), (3, 1)]
    assert two_triangles.on_border.tolist() == [True, True, True, True, False]


def test_a_part_keeps_places_and_colours_of_its_triangles_only(two_triangles):
    part = two_triangles.part(np.array([False, True]))
    assert len(part) == 1
    assert len(part.vertices) == 3
    assert part.vertices[part.triangles] == pytest.approx(two_triangles.vertices[two_triangles.triangles[[1]]])
    assert np.array_equal(part.colors[part.triangles], two_triangles.colors[two_triangles.triangles[[1]]])


def test_open3d_gets_the_same_mesh(two_triangles):
    made = two_triangles.to_open3d()
    assert made.get_surface_area() == pytest.approx(7.0)
    assert made.vertex.positions.numpy() == pytest.approx(two_triangles.vertices)


def squares(*edges: float) -> TriangleMesh:
    """A square of two triangles for each length of an edge, side by side, not connected."""
    corners = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]], np.float32)
    vertices = [corners * edge + np.float32([100 * place, 0, 0]) for place, edge in enumerate(edges)]
    triangles = [np.array([[0, 1, 2], [0, 2, 3]]) + 4 * place for place in range(len(edges))]
    return TriangleMesh(np.concatenate(vertices), np.concatenate(triangles))


def test_small_parts_are_removed_by_area():
    mesh = squares(1, 10, 2)
    assert np.allclose(mesh.without_small_parts(0.02).areas, [50, 50, 2, 2])
    assert len(mesh.without_small_parts(0.05)) == 2
    assert len(mesh.without_small_parts(0.0)) == 6
    assert len(mesh.part(np.zeros(6, bool)).without_small_parts(0.5)) == 0
