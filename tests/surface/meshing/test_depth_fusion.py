"""Fusion of runs whose depth is exact: the mesh is the surface, and nothing else."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from coliags_plugin.core.errors import InputError
from coliags_plugin.core.render_output import RenderOutput
from coliags_plugin.core.scenes import PointCloud
from coliags_plugin.core.settings import validated
from coliags_plugin.geometry.meshes.mesh import TriangleMesh
from coliags_plugin.surface.meshing import fusion
from coliags_plugin.surface.meshing.colors import best_texture
from coliags_plugin.surface.meshing.fusion import fuse_run
from coliags_plugin.surface.meshing.views import (
    MeshSettings,
    incidence_cosines,
    max_depth_of,
    rendered_depth,
    voxel_size_of,
)
from tests.scenes import camera_at, wall_color, wall_scene
from tests.surface.meshing.exact import SQUARE, WALL, depth_of, exact_run


def test_a_wall():
    mesh = fuse_run(exact_run(scene=wall_scene(17, 160, 120, lamp=False))).mesh
    assert np.abs(mesh.vertices[:, 2] - WALL).max() < 0.01
    # Seen from the cameras, which look along +z, triangles are counter-clockwise.
    assert (mesh.normals[:, 2] < -0.99).all()
    expected = wall_color(torch.from_numpy(mesh.vertices)).numpy()
    assert np.abs(mesh.colors / 255.0 - expected).max() < 0.01


def test_a_texture_of_a_wall():
    """At the centres of triangles, between vertices, it has the colour of the wall."""
    run = exact_run(scene=wall_scene(17, 160, 120, lamp=False))
    fused = fuse_run(run, MeshSettings(voxel_size=1.0, texture=4.0))
    image, corners = fused.texture.image, fused.texture.corners
    size = np.sqrt(fused.mesh.areas.sum() / 0.6) / 0.25
    assert image.shape == (int(np.ceil(size)), int(np.ceil(size)), 3)
    u, v = corners.mean(axis=1).T
    found = image[(len(image) * (1.0 - v)).astype(int), (len(image) * u).astype(int)] / 255.0
    apart = np.abs(found - wall_color(torch.from_numpy(fused.mesh.centers)).numpy())
    assert apart.mean() < 0.02 and np.quantile(apart, 0.999) < 0.06
    assert fuse_run(run, MeshSettings(voxel_size=1.0)).texture is None


def test_edges_of_three_triangles_cannot_be_textured():
    vertices = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1], [0, -1, 0]], np.float32)
    fan = TriangleMesh(vertices, np.array([[0, 1, 2], [0, 1, 3], [0, 1, 4]]))
    with pytest.raises(InputError, match="1 edges of the mesh have more than two triangles"):
        best_texture(fan, 0.1, [], lambda view: view.frame.image)


def test_no_triangles_fly_between_a_square_and_the_wall_behind_it():
    settings = MeshSettings(voxel_size=0.3)
    mesh = fuse_run(exact_run(square=True), settings).mesh
    z = mesh.vertices[:, 2]
    # At its edges, the square is as thick as the truncation.
    assert np.minimum(np.abs(z - SQUARE), np.abs(z - WALL)).max() < 0.3 * settings.truncation
    assert (z < SQUARE - 0.05).sum() == 0
    front = mesh.part(mesh.centers[:, 2] < SQUARE + 0.05)
    # Flat up to a voxel from each of its four edges.
    assert 3.4**2 <= front.areas.sum() <= 4.0**2


def test_small_parts_go_and_large_ones_stay():
    run = exact_run(square=True)
    settings = MeshSettings(voxel_size=0.3, min_part=0.5)
    assert fuse_run(run, settings).mesh.vertices[:, 2].min() > 16


@pytest.mark.parametrize("what", ["mask", "depth_at_least"])
def test_what_is_masked_or_clipped_by_the_sensor_is_not_fused(what):
    scene = wall_scene(9, 160, 120)
    left = torch.arange(160).expand(120, 160) < 80
    value = ~left if what == "mask" else torch.where(left, 15.0, torch.nan)
    spoilt = replace(scene, train=[replace(frame, **{what: value}) for frame in scene.train])
    settings = MeshSettings(voxel_size=0.3)
    half, whole = (fuse_run(exact_run(scene=s), settings).mesh.areas.sum() for s in (spoilt, scene))
    assert 0.4 < half / whole < 0.65


def test_what_lies_too_far_is_not_fused():
    with pytest.raises(InputError, match="no surface"):
        fuse_run(exact_run(), MeshSettings(max_depth=10.0))
    mesh = fuse_run(exact_run(square=True), MeshSettings(voxel_size=0.3, max_depth=11.5)).mesh
    assert mesh.vertices[:, 2].max() < 16


@pytest.mark.thorough
def test_transparent_views_have_no_surface():
    with pytest.raises(InputError, match=r"no surface.*units|no surface.*mm"):
        fuse_run(exact_run(alpha=0.7))
    assert len(fuse_run(exact_run(alpha=0.7), MeshSettings(min_alpha=0.5)).mesh)


@pytest.mark.thorough
def test_flattened_colours_are_those_of_a_held_light(monkeypatch):
    run = exact_run()
    asked = []

    def held(name, model, cameras):
        asked.append((name, len(cameras)))
        return "light"

    def dark(model, camera, light, wants):
        assert light == "light"
        size = (camera.height, camera.width)
        return RenderOutput(torch.full((*size, 3), 0.2), torch.ones(size), camera)

    monkeypatch.setattr(fusion, "held_light", held)
    monkeypatch.setattr(fusion, "render_held", dark)
    mesh = fuse_run(run, MeshSettings(color="flattened")).mesh
    assert asked == [("flattened", len(run.scene.train))]
    assert set(np.unique(mesh.colors)) == {51}
    plain = fuse_run(run).mesh
    # open3d's threads leave the order of vertices open.
    assert mesh.areas.sum() == pytest.approx(plain.areas.sum()) and len(np.unique(plain.colors)) > 1


def test_too_few_views_and_methods_without_depth_are_refused():
    assert len(fuse_run(exact_run(frames=9), MeshSettings(depth="expected")).mesh)
    scene = wall_scene(9, 160, 120)
    with pytest.raises(InputError, match="1 training view"):
        fuse_run(exact_run(scene=replace(scene, train=scene.train[:1])))
    assert len(fuse_run(exact_run(scene=replace(scene, train=scene.train[:2]))).mesh)
    with pytest.raises(InputError, match="meshing with median depth"):
        fuse_run(exact_run(depth=False))


def test_incidence_on_a_wall():
    camera = camera_at(0.0, 0.0, 0.0, 60, 40, yaw=0.4)
    found = incidence_cosines(depth_of(camera, square=False), camera)
    rays = camera.rays()
    assert torch.allclose(found, rays[..., 2].abs() / rays.norm(dim=-1))


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
    run = exact_run(scene=replace(scene, train=[replace(frame, image=image, depth_confidence=confidence)] * 2))
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
    with pytest.raises(InputError, match="--voxel"):
        voxel_size_of(settings, empty)


def test_settings_by_name():
    assert validated(MeshSettings, {"depth": "expected"}, "mesh option").depth == "expected"
    with pytest.raises(InputError, match=r"unknown key 'dept'.*Did you mean 'depth'"):
        validated(MeshSettings, {"dept": "expected"}, "mesh option")
    with pytest.raises(InputError, match="voxel_size"):
        validated(MeshSettings, {"voxel_size": 0.0}, "mesh option")
