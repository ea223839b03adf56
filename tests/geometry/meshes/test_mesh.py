"""Triangle meshes: measures against closed forms, files, true surfaces, and comparison with them."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from coliags_plugin.geometry.meshes.mesh import MESH_FORMATS, Texture, TriangleMesh, read_mesh, write_mesh
from coliags_plugin.geometry.meshes.truth import (
    TrueSurface,
    compare_meshes,
    find_true_surface,
    read_true_surface,
    sample_surface,
)
from tests.commands import refuses
from tests.surface.coverage.tubes import plane as grid_square

CORNERS = np.array([[0, 0, 0], [2, 0, 0], [0, 3, 0], [0, 0, 4], [9, 9, 9]], np.float32)
TWO = TriangleMesh(CORNERS, np.array([[0, 1, 2], [0, 3, 1]]), np.arange(15, dtype=np.uint8).reshape(5, 3))


def test_areas_normals_centers_and_the_border_of_edges_of_one_triangle():
    assert TWO.areas == pytest.approx([3.0, 4.0])
    assert TWO.normals == pytest.approx(np.array([[0, 0, 1], [0, 1, 0]]))
    assert TWO.centers == pytest.approx(np.array([[2 / 3, 1, 0], [2 / 3, 0, 4 / 3]]))
    flat = TriangleMesh(np.array([[0.0, 0, 0], [1, 1, 1], [2, 2, 2]]), np.array([[0, 1, 2]]))
    assert flat.areas == pytest.approx([0.0]) and flat.normals == pytest.approx(np.zeros((1, 3)))
    assert sorted(map(tuple, TWO.border)) == [(0, 3), (1, 2), (2, 0), (3, 1)]
    assert TWO.on_border.tolist() == [True, True, True, True, False]


def test_a_part_keeps_places_and_colours_of_its_triangles_only():
    part = TWO.part(np.array([False, True]))
    assert len(part) == 1 and len(part.vertices) == 3
    assert part.vertices[part.triangles] == pytest.approx(TWO.vertices[TWO.triangles[[1]]])
    assert np.array_equal(part.colors[part.triangles], TWO.colors[TWO.triangles[[1]]])


def squares(*edges: float) -> TriangleMesh:
    """A square of two triangles for each length of an edge, side by side, not connected."""
    corners = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]], np.float32)
    vertices = [corners * edge + np.float32([100 * place, 0, 0]) for place, edge in enumerate(edges)]
    triangles = [np.array([[0, 1, 2], [0, 2, 3]]) + 4 * place for place in range(len(edges))]
    return TriangleMesh(np.concatenate(vertices), np.concatenate(triangles))


def test_small_parts_are_removed_by_area():
    mesh = squares(1, 10, 2)
    assert np.allclose(mesh.without_small_parts(0.02).areas, [50, 50, 2, 2])
    assert len(mesh.without_small_parts(0.05)) == 2 and len(mesh.without_small_parts(0.0)) == 6
    assert len(mesh.part(np.zeros(6, bool)).without_small_parts(0.5)) == 0


@pytest.fixture(params=[True, False], ids=["coloured", "plain"])
def mesh(request):
    generator = np.random.default_rng(3)
    vertices = generator.uniform(-50, 50, (40, 3)).astype(np.float32)
    colors = generator.integers(0, 256, (40, 3)).astype(np.uint8) if request.param else None
    triangles = np.concatenate([[[0, 1, 2]], generator.permutation(39).reshape(13, 3), [[37, 38, 39]]])
    return TriangleMesh(vertices, triangles, colors)


@pytest.mark.parametrize("suffix", MESH_FORMATS)
def test_a_mesh_is_read_as_it_was_written(mesh, suffix, tmp_path):
    path = tmp_path / "new" / f"mesh.{suffix}"
    write_mesh(path, mesh)
    read = read_mesh(path)
    assert read.vertices[read.triangles] == pytest.approx(mesh.vertices[mesh.triangles], abs=1e-5)
    if mesh.colors is None:
        assert read.colors is None
    else:
        # Eight bits of linear light hold less of the dark colours.
        apart = np.abs(read.colors[read.triangles].astype(int) - mesh.colors[mesh.triangles])
        assert apart.max() <= (13 if suffix == "glb" else 0)
    assert [file.name for file in path.parent.iterdir()] == [path.name]


@pytest.mark.parametrize("suffix", ["obj", "glb"])
def test_others_find_the_colours_of_a_texture(mesh, suffix, tmp_path):
    """Each corner at a texel of its own."""
    import trimesh

    generator = np.random.default_rng(5)
    image = generator.integers(0, 256, (20, 30, 3)).astype(np.uint8)
    column, row = generator.integers(0, 30, (len(mesh), 3)), generator.integers(0, 20, (len(mesh), 3))
    corners = np.stack([(column + 0.5) / 30.0, 1.0 - (row + 0.5) / 20.0], axis=-1)
    write_mesh(tmp_path / f"mesh.{suffix}", mesh, Texture(image, corners))
    files = {"obj": {"mesh.obj", "mesh.mtl", "mesh.png"}, "glb": {"mesh.glb"}}[suffix]
    assert {file.name for file in tmp_path.iterdir()} == files
    read = trimesh.load_mesh(tmp_path / f"mesh.{suffix}", process=False)
    material = read.visual.material
    texture_image = np.asarray((material.baseColorTexture if suffix == "glb" else material.image).convert("RGB"))
    assert np.array_equal(texture_image, image)
    assert read.vertices[read.faces] == pytest.approx(mesh.vertices[mesh.triangles], abs=1e-5)
    u, v = np.moveaxis(read.visual.uv[read.faces], -1, 0)
    colors = texture_image[(20 * (1.0 - v)).astype(int), (30 * u).astype(int)]
    assert np.array_equal(colors, image[row, column])
    assert read_mesh(tmp_path / f"mesh.{suffix}").colors is None


@pytest.mark.parametrize("colors", ["1 0 0.5", "255 0 127.6"])
def test_polygons_negative_indices_and_colours_up_to_1_or_255_of_obj(colors, tmp_path):
    corners = "".join(f"v {place} {colors}\n" for place in ("0 0 0", "1 0 0", "1 1 0", "0 1 0"))
    (tmp_path / "m.obj").write_text(f"# a square\n{corners}vn 0 0 1\nf -4//1 -3//1 -2//1 -1//1\n")
    mesh = read_mesh(tmp_path / "m.obj")
    assert mesh.triangles.tolist() == [[0, 1, 2], [0, 2, 3]] and mesh.colors.tolist() == [[255, 0, 128]] * 4


@pytest.mark.parametrize(("kind", "top"), [("u1", 255), ("u2", 65535), ("f4", 1)])
def test_colours_of_glb_of_every_type(kind, top, tmp_path):
    import trimesh

    stored = (np.array([[1.0, 0.0, 0.2]] * 3) * top).astype(kind)  # 0.2 of linear light is 124 in sRGB
    exported = trimesh.Trimesh(np.eye(3), [[0, 1, 2]], process=False, vertex_attributes={"_OLOR_0": stored})
    (tmp_path / "m.glb").write_bytes(exported.export(file_type="glb").replace(b"_OLOR_0", b"COLOR_0"))
    assert read_mesh(tmp_path / "m.glb").colors.tolist() == [[255, 0, 124]] * 3


@pytest.mark.parametrize(
    ("name", "content", "message"),
    [
        ("m.stl", "solid", "no mesh file by its name"),
        ("m.obj", "v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 4\n", "vertices that are not there"),
        ("m.obj", "v 0 0 0\nv 1 0\n", "not rows of numbers"),
        ("m.obj", "v 0 0 0\nf a b c\n", "not indices"),
        ("m.obj", "v 0 0 0\n", "no triangles"),
        ("m.obj", "v nan 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n", "not finite"),
        ("m.ply", "", "cannot be read as PLY"),
        ("m.ply", "ply\nformat ascii 1.0\nelement vertex 9\n", "cannot be read as PLY"),
        ("m.obj", "v 1e30 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n", "beyond 1e"),
        ("m.glb", "glTF", "cannot be read as GLB"),
    ],
)
def test_damaged_files_are_refused(name, content, message, tmp_path):
    (tmp_path / name).write_text(content)
    refuses(message, read_mesh, tmp_path / name)
    refuses("no file", read_mesh, tmp_path / "gone.ply")


SQUARE = "v 0 0 0\nv 1 0 0\nv 1 1 0\nv 0 1 0\nvt 0.25 0.5\nvt 0.75 0.5\n"


def test_a_phantom_whose_flags_of_another_mesh_are_refused(tmp_path):
    write_mesh(tmp_path / "truth" / "mesh.ply", squares(1))
    np.savez(tmp_path / "truth" / "mesh_seen.npz", face_seen=np.array([False, True]))
    assert find_true_surface(tmp_path) == tmp_path / "truth/mesh.ply"
    for path in (tmp_path, tmp_path / "truth/mesh.ply"):
        surface = read_true_surface(path)
        assert surface.seen.tolist() == [False, True] and "training" in surface.seen_by
    for flags, message in (
        ({"face_seen": np.ones(3, bool)}, "one bool for each of 2 triangles"),
        ({"other": np.ones(2, bool)}, "face_seen"),
    ):
        np.savez(tmp_path / "truth" / "mesh_seen.npz", **flags)
        refuses(message, read_true_surface, tmp_path)


@pytest.mark.parametrize(
    "faces", ["f 1/1 2/1 3/1\nf 1/2 3/2 4/2\n", "vn 0 0 1\nf 1/1/1 2/1/1 3/1/1\nf -4/2/1 -2/2/1 -1/2/1\n"]
)
def test_c3vd_and_faces_of_any_form(tmp_path, faces):
    (tmp_path / "coverage_mesh.obj").write_text(SQUARE + faces)
    surface = read_true_surface(tmp_path)
    assert surface.seen.tolist() == [True, False] and "vt 1" in surface.seen_by
    assert np.array_equal(surface.mesh.triangles, squares(1).triangles)


def test_a_mesh_alone_says_nothing_about_what_was_seen(tmp_path):
    write_mesh(tmp_path / "wall.ply", squares(1))
    (tmp_path / "textured.obj").write_text(SQUARE + "vt 1 1\nf 1/3 2/3 3/3\n")  # other indices are no flags
    for name in ("wall.ply", "textured.obj"):
        surface = read_true_surface(tmp_path / name)
        assert surface.seen.all() and surface.seen_by == ""


def test_a_scene_without_a_true_surface(tmp_path):
    assert find_true_surface(tmp_path) is None
    refuses(r"no true surface.*coverage_mesh\.obj", read_true_surface, tmp_path)
    (tmp_path / "coverage_mesh.obj").write_text(SQUARE + "f 1/2 2/2 3/2\n")
    refuses("marks no triangle", read_true_surface, tmp_path)


COUNT = 40_000


def plane(z: float = 0.0, size: float = 40.0) -> TriangleMesh:
    """A grid_square about the origin, in 20 x 20 cells."""
    return grid_square(z, size / 2, size / 20)


def true(mesh: TriangleMesh, seen: np.ndarray | None = None) -> TrueSurface:
    return TrueSurface(Path("truth"), mesh, np.ones(len(mesh), bool) if seen is None else seen, "all")


def test_a_shifted_plane():
    compared = compare_meshes(plane(0.75), true(plane()), COUNT)
    for direction in (compared.accuracy, compared.completeness):
        assert (direction.mean, direction.median, direction.percentile_95) == pytest.approx((0.75,) * 3, abs=1e-5)
    assert (compared.chamfer, compared.hausdorff_95) == pytest.approx((0.75, 0.75), abs=1e-5)
    assert [score.f for score in compared.scores] == [0.0, 1.0, 1.0]  # nothing within 0.5 mm
    assert compared.normal_error == pytest.approx(0.0, abs=0.1) and compared.beyond_seen == 0.0
    assert compared.seen_area == pytest.approx(1600.0)


def test_missing_surface_costs_recall_and_invented_surface_precision():
    half = plane().part(plane().centers[:, 0] < 0)
    missing = compare_meshes(half, true(plane()), COUNT).scores[1]
    # What lies within 1 mm of the edge at x = 0 still counts.
    assert (missing.precision, missing.recall) == (1.0, pytest.approx(21 / 40, abs=1e-3))
    invented = compare_meshes(plane(), true(half), COUNT).scores[1]
    assert (invented.precision, invented.recall) == (pytest.approx(21 / 40, abs=1e-3), 1.0)
    assert invented.f == pytest.approx(2 * invented.precision / (1 + invented.precision))


def test_what_was_not_seen_costs_nothing():
    mesh = plane()
    seen = mesh.centers[:, 0] < 0
    half = mesh.part(seen)
    compared = compare_meshes(half, true(mesh, seen), COUNT)
    assert compared.f_at(0.5) == 1.0 and compared.beyond_seen == pytest.approx(0.0, abs=1e-3)
    assert compared.seen_area == pytest.approx(800.0)
    # Right surface that no camera saw is neither a gain nor an error.
    whole = compare_meshes(mesh, true(mesh, seen), COUNT)
    assert whole.f_at(0.5) == 1.0 and whole.beyond_seen == pytest.approx(0.5, abs=1e-3)


def test_a_turned_plane():
    angle = np.radians(5.0)
    turned = plane(size=10.0)
    x, y, _ = turned.vertices.T
    vertices = np.stack([x * np.cos(angle), y, x * np.sin(angle)], axis=1).astype(np.float32)
    # The side from which a triangle is seen does not matter.
    turned = replace(turned, vertices=vertices, triangles=turned.triangles[:, ::-1])
    compared = compare_meshes(turned, true(plane()), COUNT)
    assert compared.normal_error == pytest.approx(5.0, abs=0.01)
    assert compared.accuracy.mean == pytest.approx(2.5 * np.sin(angle), rel=1e-3)


@settings(max_examples=20, deadline=None)
@given(st.integers(1, 5000), st.integers(0, 2**31))
def test_samples_are_even_and_on_the_surface(count, seed):
    generator = np.random.default_rng(seed)
    mesh = TriangleMesh(generator.normal(size=(12, 3)).astype(np.float32), generator.permutation(12).reshape(4, 3))
    points, triangles = sample_surface(mesh, count)
    shares = mesh.areas / mesh.areas.sum()
    assert np.abs(np.bincount(triangles, minlength=4) - shares * count).max() <= 2
    corners = mesh.vertices[mesh.triangles[triangles]].astype(float)
    offsets = ((points - corners[:, 0]) * mesh.normals[triangles]).sum(axis=1)
    assert np.abs(offsets).max() < 1e-5
    again, _ = sample_surface(mesh, count)
    assert np.array_equal(points, again)


def test_samples_of_a_part():
    mesh = plane()
    points, triangles = sample_surface(mesh, 1000, mesh.centers[:, 0] > 5)
    assert points[:, 0].min() > 3.9 and (mesh.centers[triangles, 0] > 5).all()
    refuses("without area", sample_surface, mesh, 10, np.zeros(len(mesh), bool))


@pytest.mark.parametrize(("factor", "shift"), [(0.001, 0), (1000, 0), (1, 60)])
def test_another_unit_or_world_is_refused(factor, shift):
    mesh = replace(plane(), vertices=plane().vertices + np.float32([30, 0, 20]))
    other = replace(mesh, vertices=np.float32(factor) * mesh.vertices + np.float32(shift))
    refuses("one world and unit", compare_meshes, other, true(mesh), COUNT)
