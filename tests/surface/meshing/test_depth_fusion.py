"""Fusion of runs whose depth is exact: the mesh is the surface, and nothing else; its files, and the true surface."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest
import torch

from coliags_plugin.core.errors import InputError
from coliags_plugin.core.images import read_rgb
from coliags_plugin.core.provenance import Provenance
from coliags_plugin.core.render_output import RenderOutput
from coliags_plugin.core.scene_files import write_unit
from coliags_plugin.core.scenes import PointCloud
from coliags_plugin.geometry.meshes.mesh import TriangleMesh, read_mesh, write_mesh
from coliags_plugin.reporting.text_formats import terminal_text
from coliags_plugin.surface.meshing import views
from coliags_plugin.surface.meshing.fusion import first_hits, fuse_run, mesh_run
from coliags_plugin.surface.meshing.views import (
    MeshSettings,
    best_texture,
    incidence_cosines,
    max_depth_of,
    rendered_depth,
    voxel_size_of,
)
from tests.scenes import camera_at, wall_color, wall_scene, write_wall
from tests.surface.coverage.tubes import plane
from tests.surface.meshing.exact import SQUARE, WALL, exact_run


def test_a_wall_has_the_colours_of_the_wall_and_so_has_its_texture():
    """The texture at the centres of triangles, between vertices."""
    run = exact_run(scene=wall_scene(17, 160, 120, lamp=False))
    fused = fuse_run(run, MeshSettings(voxel_size=1.0, texture=4.0))
    assert np.abs(fused.mesh.vertices[:, 2] - WALL).max() < 0.01
    # Seen from the cameras, which look along +z, triangles are counter-clockwise.
    assert (fused.mesh.normals[:, 2] < -0.99).all()
    expected = wall_color(torch.from_numpy(fused.mesh.vertices)).numpy()
    assert np.abs(fused.mesh.colors / 255.0 - expected).max() < 0.01
    image, corners = fused.texture.image, fused.texture.corners
    size = np.sqrt(fused.mesh.areas.sum() / 0.6) / 0.25
    assert image.shape == (int(np.ceil(size)), int(np.ceil(size)), 3)
    u, v = corners.mean(axis=1).T
    sampled = image[(len(image) * (1.0 - v)).astype(int), (len(image) * u).astype(int)] / 255.0
    apart = np.abs(sampled - wall_color(torch.from_numpy(fused.mesh.centers)).numpy())
    assert apart.mean() < 0.02 and np.quantile(apart, 0.999) < 0.06
    assert fuse_run(run, MeshSettings(voxel_size=1.0)).texture is None


def test_edges_of_three_triangles_cannot_be_textured():
    vertices = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1], [0, -1, 0]], np.float32)
    fan = TriangleMesh(vertices, np.array([[0, 1, 2], [0, 1, 3], [0, 1, 4]]))
    with pytest.raises(InputError, match="1 edges of the mesh have more than two triangles"):
        best_texture(fan, 0.1, [])


def test_no_triangles_fly_between_a_square_and_the_wall_behind_it_and_small_parts_go():
    settings = MeshSettings(voxel_size=0.3)
    run = exact_run(square=True)
    mesh = fuse_run(run, settings).mesh
    z = mesh.vertices[:, 2]
    # At its edges, the square is as thick as the truncation.
    assert np.minimum(np.abs(z - SQUARE), np.abs(z - WALL)).max() < 0.3 * settings.truncation
    assert (z < SQUARE - 0.05).sum() == 0
    front = mesh.part(mesh.centers[:, 2] < SQUARE + 0.05)
    # Flat up to a voxel from each of its four edges.
    assert 3.4**2 <= front.areas.sum() <= 4.0**2
    assert fuse_run(run, MeshSettings(voxel_size=0.3, min_part=0.5)).mesh.vertices[:, 2].min() > 16


@pytest.mark.parametrize("what", ["mask", "depth_at_least"])
def test_what_is_masked_or_clipped_by_the_sensor_is_not_fused(what):
    scene = wall_scene(9, 160, 120)
    left = torch.arange(160).expand(120, 160) < 80
    value = ~left if what == "mask" else torch.where(left, 15.0, torch.nan)
    spoilt = replace(scene, train=[frame.with_maps(**{what: value}) for frame in scene.train])
    settings = MeshSettings(voxel_size=0.3)
    half, whole = (fuse_run(exact_run(scene=s), settings).mesh.areas.sum() for s in (spoilt, scene))
    assert 0.4 < half / whole < 0.65


def test_what_lies_too_far_is_not_fused():
    with pytest.raises(InputError, match="no surface"):
        fuse_run(exact_run(), MeshSettings(max_depth=10.0))
    mesh = fuse_run(exact_run(square=True), MeshSettings(voxel_size=0.3, max_depth=11.5)).mesh
    assert mesh.vertices[:, 2].max() < 16


@pytest.mark.thorough
def test_flattened_colours_are_those_of_a_held_light(monkeypatch):
    run = exact_run()
    calls = []

    def held(name, model, cameras):
        calls.append((name, len(cameras)))
        return "light"

    def dark(model, camera, light, wants):
        assert light == "light"
        size = (camera.height, camera.width)
        return RenderOutput(torch.full((*size, 3), 0.2), torch.ones(size), camera)

    monkeypatch.setattr(views, "held_light", held)
    monkeypatch.setattr(views, "render_held", dark)
    mesh = fuse_run(run, MeshSettings(color="flattened")).mesh
    assert calls == [("flattened", len(run.scene.train))]
    assert set(np.unique(mesh.colors)) == {51}


def test_too_few_views_and_methods_without_depth_are_refused():
    assert len(fuse_run(exact_run(frames=9), MeshSettings(depth="expected")).mesh)
    scene = wall_scene(9, 160, 120)
    with pytest.raises(InputError, match="1 training view"):
        fuse_run(exact_run(scene=replace(scene, train=scene.train[:1])))
    assert len(fuse_run(exact_run(scene=replace(scene, train=scene.train[:2]))).mesh)
    with pytest.raises(InputError, match="meshing with median depth"):
        fuse_run(exact_run(depth=False))


def test_incidence_at_a_jump():
    """The last pixels before a jump count as the wall; a pixel in its midst as very oblique."""
    camera = camera_at(0.0, 0.0, 0.0, 60, 40)
    depth = torch.full((40, 60), 20.0, dtype=torch.float64)
    depth[:, 30] = 15.0
    depth[:, 31:] = 10.0
    cosines = incidence_cosines(depth, camera)
    assert cosines[:, 30].max() < 0.1
    assert cosines[:, [28, 29, 31, 32]].min() > 0.8
    depth[:, 30] = torch.nan
    cosines = incidence_cosines(depth, camera)
    assert cosines[:, [29, 31]].min() > 0.8 and not cosines[:, 30].isfinite().any()


def test_quality_of_views():
    """Confidence times cosine times nearness; a tenth of it at highlights and about them."""
    scene = wall_scene(9, 160, 120)
    frame = scene.train[0]
    confidence = torch.full((120, 160), 0.5)
    image = frame.image.clone()
    image[60, 80] = 255
    run = exact_run(scene=replace(scene, train=[frame.with_maps(image=image, depth_confidence=confidence)] * 2))
    view = next(rendered_depth(run, MeshSettings()))
    rays = frame.camera.rays()
    pixel = view.depth.double() / (frame.camera.fx * frame.camera.fy) ** 0.5
    expected = 0.5 * rays[..., 2] / rays.norm(dim=-1) * run.scene.pixel_footprint / pixel
    about = (torch.arange(120)[:, None] - 60).abs().maximum((torch.arange(160) - 80).abs()) <= 2
    torch.testing.assert_close(view.quality.double(), torch.where(about, 0.1, 1.0) * expected, rtol=1e-4, atol=1e-6)


def test_defaults_follow_the_scene():
    scene = wall_scene(9, 160, 120)
    settings = MeshSettings()
    assert voxel_size_of(settings, scene) == 2 * scene.pixel_footprint
    assert voxel_size_of(MeshSettings(voxel_size=0.7), scene) == 0.7
    # The first training camera stands at z = 0.5, and the points lie on the wall.
    assert max_depth_of(settings, scene) == pytest.approx(WALL - 0.5, abs=1e-4)
    empty = replace(scene, points=PointCloud(torch.zeros(0, 3)))
    assert max_depth_of(settings, empty) == float("inf")
    with pytest.raises(InputError, match="`voxel=SIZE`"):
        voxel_size_of(settings, empty)


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
    meshed = mesh_run(exact_run(), tmp_path / "mesh", SETTINGS, truth=truth)
    names = {"mesh.ply", "mesh.obj", "mesh.glb", "mesh.json", "comparison.png", "mesh_error.ply", "truth_error.ply"}
    assert {path.name for path in meshed.folder.iterdir()} == names
    summary = json.loads((meshed.folder / "mesh.json").read_text())
    assert (summary["method"], summary["unit"], summary["views"], summary["step"]) == ("exact", "mm", 14, 100)
    assert summary["holes_closed"] == 0
    assert summary["triangles"] == len(meshed.mesh) == len(read_mesh(meshed.folder / "mesh.ply"))
    assert summary["settings"]["voxel_size"] == 0.4
    assert summary["area"] == pytest.approx(meshed.mesh.areas.sum())
    compared = meshed.comparison
    assert summary["comparison"]["chamfer"] == compared.chamfer
    assert summary["comparison"]["scores"][1]["f"] == compared.f_at(1.0) > 0.98
    assert compared.accuracy.mean < 0.01 and compared.normal_error < 1.0
    assert "cast" in compared.seen_by
    assert f"{compared.chamfer:.3f} mm" in terminal_text(meshed.comparison_blocks())
    errors = read_mesh(meshed.folder / "truth_error.ply")
    corner = np.abs(errors.vertices[:, :2]).min(axis=1) > 29
    assert (errors.colors[corner] == 128).all(), "what was not seen is grey"
    assert read_rgb(meshed.folder / "comparison.png").shape[2] == 3


def test_with_a_texture(tmp_path):
    meshed = mesh_run(exact_run(frames=9), tmp_path / "mesh", MeshSettings(voxel_size=1.0, texture=2.0))
    names = {"mesh.ply", "mesh.obj", "mesh.mtl", "mesh.png", "mesh.glb", "mesh.json"}
    assert {path.name for path in meshed.folder.iterdir()} == names
    size = json.loads((meshed.folder / "mesh.json").read_text())["texture"]
    assert read_rgb(meshed.folder / "mesh.png").shape == (size, size, 3)
    assert read_mesh(meshed.folder / "mesh.ply").colors is not None, "PLY keeps colours at vertices"


@pytest.mark.thorough
def test_truth_beside_the_scene_is_found(tmp_path):
    (tmp_path / "scene/truth").mkdir(parents=True)
    write_mesh(tmp_path / "scene/truth/mesh.ply", wall_mesh())
    np.savez(tmp_path / "scene/truth/mesh_seen.npz", face_seen=np.abs(wall_mesh().centers[:, :2]).max(axis=1) < 5)
    scene = replace(wall_scene(9, 160, 120), folder=tmp_path / "scene")
    meshed = mesh_run(exact_run(scene=scene), tmp_path / "mesh", SETTINGS)
    assert meshed.comparison.seen_area == pytest.approx(100.0, rel=0.15)
    assert meshed.comparison.scores[0].recall == 1.0


def test_what_is_there_is_not_replaced_unless_told(tmp_path):
    (tmp_path / "mesh").mkdir()
    (tmp_path / "mesh/mine").write_text("mine")
    with pytest.raises(InputError, match="already exists"):
        mesh_run(exact_run(frames=9), tmp_path / "mesh", SETTINGS)
    assert (tmp_path / "mesh/mine").read_text() == "mine"
    meshed = mesh_run(exact_run(frames=9), tmp_path / "mesh", SETTINGS, formats=("obj",), overwrite=True)
    assert {path.name for path in meshed.folder.iterdir()} == {"mesh.obj", "mesh.json"}
    assert meshed.comparison is json.loads((meshed.folder / "mesh.json").read_text())["comparison"] is None


def test_a_failure_leaves_nothing(truth, tmp_path):
    with pytest.raises(InputError, match="no surface"):
        mesh_run(exact_run(frames=9, alpha=0.7), tmp_path / "mesh", SETTINGS)
    assert len(fuse_run(exact_run(frames=9, alpha=0.7), MeshSettings(min_alpha=0.5)).mesh)
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
    """Figures name its unit, and truth in mm is only that of a scene with the same poses."""
    folder = write_wall(tmp_path / "wall", 9, 160, 120)
    scene = replace(wall_scene(9, 160, 120), provenance=Provenance(unit="unknown"))
    run = exact_run(scene=scene)
    with pytest.raises(InputError, match="unknown scale"):
        mesh_run(run, tmp_path / "mesh", SETTINGS, truth=truth)
    (folder / "truth").mkdir()
    write_mesh(folder / "truth/mesh.ply", wall_mesh())
    meshed = mesh_run(run, tmp_path / "compared", SETTINGS, formats=("ply",), truth=folder)
    assert meshed.comparison.f_at(0.5) > 0.9
    assert meshed.comparison.unit == "mm", "the unit that the scene shares with that of the truth"
    assert json.loads((meshed.folder / "mesh.json").read_text())["unit"] == "unknown"
    write_unit(folder, "unknown")
    meshed = mesh_run(run, tmp_path / "unknown", SETTINGS, formats=("ply",), truth=folder)
    printed = terminal_text(meshed.comparison_blocks())
    assert f"{meshed.comparison.chamfer:.3f} units" in printed and "mm" not in printed
    elsewhere = [replace(frame, camera=camera_at(index, 3.0, 0.0, 160, 120)) for index, frame in enumerate(scene.train)]
    other = exact_run(scene=replace(scene, train=elsewhere))
    with pytest.raises(InputError, match="same poses"):
        mesh_run(other, tmp_path / "third", SETTINGS, truth=folder)


def test_first_hits_are_what_the_views_see():
    frames = wall_scene(9, 160, 120).train[:1]
    mesh = wall_mesh()
    hit = first_hits(mesh, frames)
    camera = frames[0].camera
    pixels, _ = camera.project(torch.from_numpy(mesh.centers))
    inside = ((pixels > 4) & (pixels < torch.tensor([156, 116]))).all(dim=1).numpy()
    outside = ((pixels < -4) | (pixels > torch.tensor([164, 124]))).any(dim=1).numpy()
    assert hit[inside].all() and not hit[outside].any()
    hidden = frames[0].with_maps(mask=torch.zeros(120, 160, dtype=torch.bool))
    assert not first_hits(mesh, [hidden]).any()
