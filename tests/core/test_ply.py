"""PLY files, read back by Open3D."""

from __future__ import annotations

import numpy as np

from coliags_plugin.core.ply import point_properties, write_ply


def test_points_with_and_without_colours(tmp_path):
    import open3d

    positions, colors = np.arange(6.0).reshape(2, 3), np.array([[1, 2, 3], [255, 0, 128]], np.uint8)
    write_ply(tmp_path / "folder" / "points.ply", point_properties(positions, colors))
    cloud = open3d.io.read_point_cloud(str(tmp_path / "folder" / "points.ply"))
    np.testing.assert_array_equal(cloud.points, positions)
    np.testing.assert_allclose(cloud.colors, colors / 255.0)
    write_ply(tmp_path / "plain.ply", point_properties(positions))
    assert not open3d.io.read_point_cloud(str(tmp_path / "plain.ply")).has_colors()


def test_triangles_and_a_comment(tmp_path):
    import open3d

    positions = np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])
    write_ply(tmp_path / "mesh.ply", point_properties(positions), np.array([[0, 1, 2]]), "millimetres")
    mesh = open3d.io.read_triangle_mesh(str(tmp_path / "mesh.ply"))
    assert np.asarray(mesh.triangles).tolist() == [[0, 1, 2]]
    np.testing.assert_array_equal(mesh.vertices, positions)
    assert b"\ncomment millimetres\n" in (tmp_path / "mesh.ply").read_bytes()


def test_other_types_become_float32(tmp_path):
    write_ply(tmp_path / "rows.ply", {"x": np.array([1, 2]), "weight": np.array([0.5, 0.25])})
    header, _, body = (tmp_path / "rows.ply").read_bytes().partition(b"end_header\n")
    assert header.endswith(b"element vertex 2\nproperty float x\nproperty float weight\n")
    assert np.frombuffer(body, "<f4").tolist() == [1.0, 0.5, 2.0, 0.25]
