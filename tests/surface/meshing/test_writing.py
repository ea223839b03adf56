"""Files of a mesh, and its comparison with a true surface."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest
import torch

from coliags_plugin.core.errors import InputError
from coliags_plugin.core.images import read_rgb
from coliags_plugin.datamanagers.units import write_unit
from coliags_plugin.geometry.meshes.files import read_mesh, write_mesh
from coliags_plugin.geometry.meshes.mesh import TriangleMesh
from coliags_plugin.reporting.text_formats import terminal_text
from coliags_plugin.surface.meshing.fusion import comparison_blocks, first_hits, mesh_run
from coliags_plugin.surface.meshing.views import MeshSettings
from tests.scenes import wall_scene, write_wall
from tests.surface.coverage.tubes import plane
from tests.surface.meshing.exact import exact_run, with_provenance

SETTINGS = MeshSettings(voxel_size=0.4)


def wall_mesh() -> TriangleMesh:
    """The wall z = 20, of 60 mm, as a grid of triangles of half a millimetre squared."""
    return plane(20.0, 30.0, 0.6)


@pytest.fixture(scope="module")
def truth(tmp_path_factory):
    path = tmp_path_factory.mktemp("truth") / "wall.ply"
    write_mesh(path, wall_mesh())
    return path


def test_files_and_figures(truth, tmp_path):
    made = mesh_run(exact_run(), tmp_path / "mesh", SETTINGS, truth=truth)
    names = {"mesh.ply", "mesh.obj", "mesh.glb", "mesh.json", "comparison.png", "mesh_error.ply", "truth_error.ply"}
    assert {path.name for path in made.folder.iterdir()} == names
    summary = json.loads((made.folder / "mesh.json").read_text())
    assert (summary["method"], summary["unit"], summary["views"], summary["step"]) == ("exact", "mm", 14, 100)
    assert summary["holes_closed"] == 0
    assert summary["triangles"] == len(made.mesh) == len(read_mesh(made.folder / "mesh.ply"))
    assert summary["settings"]["voxel_size"] == 0.4
    assert summary["area"] == pytest.approx(made.mesh.areas.sum())
    compared = made.comparison
    assert summary["comparison"]["chamfer"] == compared.chamfer
    assert summary["comparison"]["scores"][1]["f"] == compared.f_at(1.0) > 0.98
    assert compared.accuracy.mean < 0.01 and compared.normal_error < 1.0
    assert "cast" in compared.seen_by
    assert f"{compared.chamfer:.3f} mm" in terminal_text(comparison_blocks(compared))
    errors = read_mesh(made.folder / "truth_error.ply")
    corner = np.abs(errors.vertices[:, :2]).min(axis=1) > 29
    assert (errors.colors[corner] == 128).all(), "what was not seen is grey"
    assert read_rgb(made.folder / "comparison.png").shape[2] == 3


def test_without_truth(tmp_path):
    made = mesh_run(exact_run(frames=9), tmp_path / "mesh", SETTINGS, formats=("obj",))
    assert {path.name for path in made.folder.iterdir()} == {"mesh.obj", "mesh.json"}
    assert made.comparison is None
    assert json.loads((made.folder / "mesh.json").read_text())["comparison"] is None


def test_with_a_texture(tmp_path):
    made = mesh_run(exact_run(frames=9), tmp_path / "mesh", MeshSettings(voxel_size=1.0, texture=2.0))
    names = {"mesh.ply", "mesh.obj", "mesh.mtl", "mesh.png", "mesh.glb", "mesh.json"}
    assert {path.name for path in made.folder.iterdir()} == names
    size = json.loads((made.folder / "mesh.json").read_text())["texture"]
    assert read_rgb(made.folder / "mesh.png").shape == (size, size, 3)
    assert read_mesh(made.folder / "mesh.ply").colors is not None, "PLY keeps colours at vertices"


@pytest.mark.thorough
def test_truth_beside_the_scene_is_found(tmp_path):
    (tmp_path / "scene/truth").mkdir(parents=True)
    write_mesh(tmp_path / "scene/truth/mesh.ply", wall_mesh())
    np.savez(tmp_path / "scene/truth/mesh_seen.npz", face_seen=np.abs(wall_mesh().centers[:, :2]).max(axis=1) < 5)
    scene = replace(wall_scene(9, 160, 120), folder=tmp_path / "scene")
    made = mesh_run(exact_run(scene=scene), tmp_path / "mesh", SETTINGS)
    assert made.comparison.seen_area == pytest.approx(100.0, rel=0.15)
    assert made.comparison.scores[0].recall == 1.0


def test_what_is_there_is_not_replaced_unless_told(tmp_path):
    (tmp_path / "mesh").mkdir()
    (tmp_path / "mesh/mine").write_text("mine")
    with pytest.raises(InputError, match="already exists"):
        mesh_run(exact_run(frames=9), tmp_path / "mesh", SETTINGS)
    assert (tmp_path / "mesh/mine").read_text() == "mine"
    mesh_run(exact_run(frames=9), tmp_path / "mesh", SETTINGS, formats=("ply",), overwrite=True)
    assert not (tmp_path / "mesh/mine").exists()


def test_a_failure_leaves_nothing(truth, tmp_path):
    with pytest.raises(InputError, match="no surface"):
        mesh_run(exact_run(frames=9, alpha=0.1), tmp_path / "mesh", SETTINGS)
    with pytest.raises(InputError, match="no file"):
        mesh_run(exact_run(frames=9), tmp_path / "mesh", SETTINGS, truth=tmp_path / "gone.ply")
    assert not any(tmp_path.iterdir())


def test_truth_of_another_unit_is_refused(tmp_path):
    mesh = wall_mesh()
    write_mesh(tmp_path / "metres.ply", replace(mesh, vertices=mesh.vertices * np.float32(0.001)))
    with pytest.raises(InputError, match=r"in mm|one world and unit"):
        mesh_run(exact_run(frames=9), tmp_path / "mesh", SETTINGS, truth=tmp_path / "metres.ply")
    behind = replace(mesh, vertices=mesh.vertices * np.float32([1, 1, -1]))
    write_mesh(tmp_path / "behind.ply", behind)
    with pytest.raises(InputError, match="sees any"):
        mesh_run(exact_run(frames=9), tmp_path / "mesh", SETTINGS, truth=tmp_path / "behind.ply")
    assert not (tmp_path / "mesh").exists()


@pytest.mark.thorough
def test_a_scene_of_unknown_scale(truth, tmp_path):
    """Its unit is said, and truth in mm is only that of a scene with the same poses."""
    folder = write_wall(tmp_path / "wall", 9, 160, 120)
    run = exact_run(scene=with_provenance(wall_scene(9, 160, 120), unit="unknown"))
    with pytest.raises(InputError, match="unknown scale"):
        mesh_run(run, tmp_path / "mesh", SETTINGS, truth=truth)
    made = mesh_run(run, tmp_path / "mesh", SETTINGS, formats=("ply",))
    assert json.loads((made.folder / "mesh.json").read_text())["unit"] == "unknown"
    (folder / "truth").mkdir()
    write_mesh(folder / "truth/mesh.ply", wall_mesh())
    made = mesh_run(run, tmp_path / "compared", SETTINGS, formats=("ply",), truth=folder)
    assert made.comparison.f_at(0.5) > 0.9
    assert made.comparison.unit == "mm", "the unit that the scene shares with that of the truth"
    write_unit(folder, "unknown")
    compared = mesh_run(run, tmp_path / "unknown", SETTINGS, formats=("ply",), truth=folder).comparison
    printed = terminal_text(comparison_blocks(compared))
    assert f"{compared.chamfer:.3f} units" in printed and "mm" not in printed
    scene = wall_scene(9, 160, 120)
    shift = torch.zeros(4, 4)
    shift[0, 3] = 3.0
    moved = [
        replace(frame, camera=replace(frame.camera, camera_to_world=frame.camera.camera_to_world + shift))
        for frame in scene.train
    ]
    other = exact_run(scene=with_provenance(replace(scene, train=moved), unit="unknown"))
    with pytest.raises(InputError, match="same poses"):
        mesh_run(other, tmp_path / "third", SETTINGS, truth=folder)


def test_first_hits_are_what_the_views_see():
    frames = wall_scene(9, 160, 120).train[:1]
    mesh = wall_mesh()
    seen = first_hits(mesh, frames)
    camera = frames[0].camera
    pixels, _ = camera.project(torch.from_numpy(mesh.centers))
    inside = ((pixels > 4) & (pixels < torch.tensor([156, 116]))).all(dim=1).numpy()
    outside = ((pixels < -4) | (pixels > torch.tensor([164, 124]))).any(dim=1).numpy()
    assert seen[inside].all() and not seen[outside].any()
    hidden = replace(frames[0], mask=torch.zeros(120, 160, dtype=torch.bool))
    assert not first_hits(mesh, [hidden]).any()
