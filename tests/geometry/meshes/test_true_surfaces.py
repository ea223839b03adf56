"""True surfaces of phantoms and of C3VD, and what was seen of them."""

from __future__ import annotations

import numpy as np
import pytest

from coliags_plugin.core.errors import InputError
from coliags_plugin.geometry.meshes.files import write_mesh
from coliags_plugin.geometry.meshes.mesh import TriangleMesh
from coliags_plugin.geometry.meshes.truth import find_true_surface, read_true_surface

SQUARE = TriangleMesh(
    np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]], np.float32), np.array([[0, 1, 2], [0, 2, 3]])
)
VERTICES = "v 0 0 0\nv 1 0 0\nv 1 1 0\nv 0 1 0\nvt 0.25 0.5\nvt 0.75 0.5\n"


@pytest.fixture
def phantom(tmp_path):
    write_mesh(tmp_path / "truth" / "mesh.ply", SQUARE)
    np.savez(tmp_path / "truth" / "mesh_seen.npz", face_seen=np.array([False, True]))
    return tmp_path


def test_a_phantom(phantom):
    assert find_true_surface(phantom) == phantom / "truth/mesh.ply"
    for path in (phantom, phantom / "truth/mesh.ply"):
        surface = read_true_surface(path)
        assert surface.seen.tolist() == [False, True]
        assert "training" in surface.seen_by


@pytest.mark.parametrize(
    "faces", ["f 1/1 2/1 3/1\nf 1/2 3/2 4/2\n", "vn 0 0 1\nf 1/1/1 2/1/1 3/1/1\nf -4/2/1 -2/2/1 -1/2/1\n"]
)
def test_c3vd_and_faces_of_any_form(tmp_path, faces):
    (tmp_path / "coverage_mesh.obj").write_text(VERTICES + faces)
    surface = read_true_surface(tmp_path)
    assert surface.seen.tolist() == [True, False]
    assert "vt 1" in surface.seen_by
    assert np.array_equal(surface.mesh.triangles, SQUARE.triangles)


def test_a_mesh_alone_says_nothing_about_what_was_seen(tmp_path):
    write_mesh(tmp_path / "wall.ply", SQUARE)
    surface = read_true_surface(tmp_path / "wall.ply")
    assert surface.seen.all() and surface.seen_by == ""
    # Other texture indices are no flags.
    (tmp_path / "textured.obj").write_text(VERTICES + "vt 1 1\nf 1/1 2/2 3/3\n")
    assert read_true_surface(tmp_path / "textured.obj").seen_by != ""


@pytest.mark.parametrize(
    ("text", "message"),
    [(None, r"no true surface.*coverage_mesh\.obj"), (VERTICES + "f 1/2 2/2 3/2\n", "marks no triangle")],
)
def test_a_scene_without(tmp_path, text, message):
    if text is None:
        assert find_true_surface(tmp_path) is None
    else:
        (tmp_path / "coverage_mesh.obj").write_text(text)
    with pytest.raises(InputError, match=message):
        read_true_surface(tmp_path)


def test_flags_of_another_mesh_are_refused(phantom):
    np.savez(phantom / "truth" / "mesh_seen.npz", face_seen=np.ones(3, bool))
    with pytest.raises(InputError, match="one bool for each of 2 triangles"):
        read_true_surface(phantom)
    np.savez(phantom / "truth" / "mesh_seen.npz", other=np.ones(2, bool))
    with pytest.raises(InputError, match="face_seen"):
        read_true_surface(phantom)
