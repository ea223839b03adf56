"""Which triangles are seen, and how well, on surfaces with closed forms."""

from __future__ import annotations

import numpy as np
import pytest

from coliags_plugin.core.errors import InputError
from coliags_plugin.core.settings import validated
from coliags_plugin.geometry.lenses.models import LENSES, octagon_mask
from coliags_plugin.geometry.meshes.mesh import TriangleMesh
from coliags_plugin.surface.coverage.measure import connected, large_regions, near_pairs, neighbours
from coliags_plugin.surface.coverage.visibility import (
    CoverageSettings,
    Level,
    RayGrid,
    classify,
    facing_cameras,
    see_faces,
)
from tests.surface.coverage.tubes import joined, pinhole, plane, sphere, tube, view_at


def solid_angle(lens) -> float:
    """Of the image of a centred pinhole camera."""
    x, y = 0.5 * lens.width / lens.fx, 0.5 * lens.height / lens.fy
    return 4.0 * np.arctan(x * y / np.sqrt(1.0 + x * x + y * y))


def test_pixel_angles_add_up_to_the_field_of_view():
    lens = pinhole()
    for most in (500, 4000, 100_000):
        grid = RayGrid.of(lens, None, most)
        rays_per_pixel = len(grid.cells) / (lens.width * lens.height)
        assert len(grid.cells) <= max(most, 4 * lens.width * lens.height) * 1.05
        assert grid.pixel_angles.sum() / rays_per_pixel == pytest.approx(solid_angle(lens), rel=0.01)


def test_rays_of_a_wide_lens_are_those_of_its_pixels_within_the_mask():
    lens = LENSES["omnidirectional"].resized(135, 108)
    mask = octagon_mask(135, 108)
    grid = RayGrid.of(lens, mask, 135 * 108)
    row, column = np.divmod(grid.cells, 135)
    assert np.array_equal(mask[row, column], np.ones(len(row), bool)) and len(row) == mask.sum()
    again = lens.project(grid.directions.astype(float) * 7.0)
    assert np.allclose(again, np.stack([column, row], axis=1) + 0.5, atol=1e-3)


def test_a_sphere_seen_from_its_centre():
    lens, radius = pinhole(), 30.0
    mesh = sphere(radius)
    views = see_faces(mesh, [view_at((0, 0, 0), (1, 0.2, 0.3), lens)])
    area = mesh.areas[views.seen].sum()
    # Triangles that the edge of the image crosses count whole.
    assert area == pytest.approx(solid_angle(lens) * radius**2, rel=0.06)
    assert np.allclose(views.distance[views.seen], radius, rtol=1e-3)
    assert views.incidence[views.seen].max() < 2.5
    assert views.frames.max() == 1 and (views.best_frame[views.seen] == 0).all() and (views.best_frame < 1).all()
    assert np.isnan(views.distance[~views.seen]).all() and np.isnan(views.brightness).all()
    # On the axis, a pixel of 1/f radians covers r / f of the surface.
    assert views.pixels_per_length[views.seen].min() == pytest.approx(lens.fx / radius, rel=0.02)


def test_an_occluder_hides_its_shadow():
    back, front = plane(40.0, 30.0), plane(20.0, 5.0)
    mesh = joined(back, front)
    views = see_faces(mesh, [view_at((0, 0, 0), lens=pinhole(300, 300, 150.0))], CoverageSettings(rays=100_000))
    seen = views.seen[: len(back)]
    inner = np.abs(back.centers[:, :2]).max(axis=1)
    assert not seen[inner < 10.0 - 0.5].any()
    assert seen[(inner > 10.0 + 0.5) & (inner < 29.0)].all()
    assert views.seen[len(back) :].all()


def test_two_frames_are_counted_and_the_best_of_each_measure_is_kept():
    mesh = plane(40.0, 5.0, 2.0)
    near, far = view_at((0, 0, 20), grey=20), view_at((0, 0, 0), grey=200)
    views = see_faces(mesh, [far, near])
    middle = int(np.argmin(np.linalg.norm(mesh.centers[:, :2], axis=1)))
    assert views.frames[middle] == 2 and views.best_frame[middle] == 1
    assert views.distance[middle] == pytest.approx(20.0, abs=0.15)
    assert views.brightness[middle] == pytest.approx(200 / 255, abs=1e-3)
    assert views.pixels_per_length[middle] == pytest.approx(40.0 / 20.0, rel=0.02)


def test_triangles_between_the_rays_are_seen_by_their_centroids():
    mesh = joined(plane(40.0, 30.0, 0.25), plane(20.0, 5.0, 0.25))
    views = see_faces(mesh, [view_at((0, 0, 0), lens=pinhole(30, 30, 15.0), grey=100)], CoverageSettings(rays=1000))
    inner = np.abs(mesh.centers[:, :2]).max(axis=1)
    back = mesh.centers[:, 2] > 30.0
    assert views.seen[back & (inner > 10.2) & (inner < 29.5)].all() and views.seen[~back].all()
    assert not views.seen[back & (inner < 9.8)].any()
    assert np.allclose(views.distance[~back], np.linalg.norm(mesh.centers[~back], axis=1), atol=0.3)
    assert np.isfinite(views.brightness[views.seen]).all()


def test_surface_beyond_the_range_is_not_seen():
    mesh, camera = plane(40.0, 5.0), [view_at((0, 0, 0))]
    assert see_faces(mesh, camera, CoverageSettings(max_distance=41.0)).seen.all()
    assert not see_faces(mesh, camera, CoverageSettings(max_distance=39.0)).seen.any()


def test_only_the_front_is_seen_and_a_mesh_is_turned_to_the_cameras():
    mesh, camera = plane(40.0, 5.0), [view_at((0, 0, 0))]
    turned = TriangleMesh(mesh.vertices, mesh.triangles[:, ::-1])
    assert not see_faces(turned, camera).seen.any()
    assert np.array_equal(facing_cameras(turned, camera).triangles, mesh.triangles)
    assert facing_cameras(mesh, camera) is mesh


def test_masked_pixels_see_nothing():
    lens = pinhole()
    mask = np.zeros((lens.height, lens.width), bool)
    mask[:, : lens.width // 2] = True
    mesh = plane(40.0, 5.0, 1.0)
    seen = see_faces(mesh, [view_at((0, 0, 0), lens=lens, mask=mask)]).seen
    assert seen[mesh.centers[:, 0] < -1.0].all() and not seen[mesh.centers[:, 0] > 1.0].any()


def test_levels_tell_a_glance_darkness_and_distance_apart():
    mesh, options = plane(40.0, 5.0, 2.0), CoverageSettings(glance_frames=2, far=50.0, dark=0.2, grazing=60.0)

    def level(*views):
        found = np.unique(classify(see_faces(mesh, views, options), options))
        assert len(found) == 1
        return Level(found[0])

    good, dark, far = view_at((0, 0, 0), grey=100), view_at((0, 0, 0), grey=20), view_at((0, 0, -20), grey=100)
    slanted = view_at((60, 0, 15), (-60, 0, 25), grey=100, lens=pinhole(focal=200.0))
    near_slant = CoverageSettings(glance_frames=1, far=100.0, dark=0.2, grazing=60.0)
    assert level(good, good) == Level.SEEN
    assert level(good) == Level.GLANCE and level(good, dark) == Level.GLANCE
    assert level(dark, dark) == Level.POOR and level(far, far) == Level.POOR
    assert level(view_at((0, 0, 0), (0, 0, -1))) == Level.UNSEEN
    found = classify(see_faces(mesh, [slanted], near_slant), near_slant)
    assert set(found) == {Level.GLANCE}


def test_input_that_cannot_be_measured_is_refused():
    mesh = tube()
    with pytest.raises(InputError, match="no viewing ray"):
        facing_cameras(mesh, [view_at((0, 0, 500.0))])
    with pytest.raises(InputError, match="without frames"):
        facing_cameras(mesh, [])
    with pytest.raises(InputError, match="without triangles"):
        see_faces(mesh.part(np.zeros(len(mesh), bool)), [view_at((0, 0, 0))])
    with pytest.raises(InputError, match=r"coverage option far: .*got -3\.0"):
        validated(CoverageSettings, {"far": -3.0}, "coverage option")


def test_neighbours_share_edges_and_regions_are_what_is_connected():
    mesh = plane(0.0, 2.0, 1.0)
    pairs = neighbours(mesh)
    # 4 x 4 squares: a diagonal in each, and 2 * 4 * 3 inner edges.
    assert len(pairs) == 16 + 24
    left, right = mesh.centers[:, 0] < -1.0, mesh.centers[:, 0] > 1.0
    numbers = connected(left | right, pairs)
    assert set(numbers[left]) != set(numbers[right]) and set(numbers[~left & ~right]) == {-1}
    assert [len(region) for region in large_regions(left | right, pairs, mesh.areas, 3.9)] == [8, 8]
    assert large_regions(left, pairs, mesh.areas, 4.1) == []
    bridged = np.concatenate([pairs, near_pairs(mesh.centers, left, right, 3.0)])
    assert len(large_regions(left | right, bridged, mesh.areas, 0.0)) == 1
    assert len(near_pairs(mesh.centers, left, right, 0.5)) == 0
    assert len(near_pairs(mesh.centers, left, np.zeros(32, bool), 9.0)) == 0
