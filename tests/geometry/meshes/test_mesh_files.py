"""Files of meshes: what is written is read again, by this package and by others; damaged files are refused."""

from __future__ import annotations

import numpy as np
import pytest

from coliags_plugin.core.errors import InputError
from coliags_plugin.geometry.meshes.files import MESH_FORMATS, read_mesh, write_mesh
from coliags_plugin.geometry.meshes.mesh import Texture, TriangleMesh


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
    found = np.asarray((material.baseColorTexture if suffix == "glb" else material.image).convert("RGB"))
    assert np.array_equal(found, image)
    assert read.vertices[read.faces] == pytest.approx(mesh.vertices[mesh.triangles], abs=1e-5)
    u, v = np.moveaxis(read.visual.uv[read.faces], -1, 0)
    colors = found[(20 * (1.0 - v)).astype(int), (30 * u).astype(int)]
    assert np.array_equal(colors, image[row, column])
    assert read_mesh(tmp_path / f"mesh.{suffix}").colors is None


def test_obj_polygons_and_negative_indices(tmp_path):
    path = tmp_path / "quad.obj"
    path.write_text("# a square\nv 0 0 0\nv 1 0 0\nv 1 1 0\nv 0 1 0\nvn 0 0 1\nf -4//1 -3//1 -2//1 -1//1\n")
    mesh = read_mesh(path)
    assert mesh.triangles.tolist() == [[0, 1, 2], [0, 2, 3]]
    assert mesh.areas.sum() == 1.0


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
    with pytest.raises(InputError, match=message):
        read_mesh(tmp_path / name)
    with pytest.raises(InputError, match="no file"):
        read_mesh(tmp_path / "gone.ply")
