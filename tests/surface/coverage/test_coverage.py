"""Coverage with closed forms: what is seen, centrelines, holes and missed regions; and the command on phantoms."""

from __future__ import annotations

import csv
import html
import json
import re
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import tests.layouts  # noqa: F401  (registers c3vd-raw)
from coliags_plugin.api.scenes import make_phantom
from coliags_plugin.core.errors import InputError
from coliags_plugin.core.images import read_8_bit, write_image
from coliags_plugin.core.provenance import Provenance
from coliags_plugin.core.settings import validated
from coliags_plugin.geometry.meshes.mesh import TriangleMesh, read_mesh, write_mesh
from coliags_plugin.surface.coverage.centreline import (
    NoLumenError,
    find_centreline,
    find_section,
    guessed_wall,
    wall_around,
)
from coliags_plugin.surface.coverage.measure import (
    PartialCoverage,
    large_regions,
    measure_coverage,
    near_pairs,
    neighbours,
)
from coliags_plugin.surface.coverage.visibility import (
    MAP_LEGEND,
    CoverageSettings,
    Level,
    RayGrid,
    classify,
    facing_cameras,
    recorded_views,
    see_faces,
)
from coliags_plugin.surface.coverage.writing import (
    RESEARCH_USE,
    draw_map,
    draw_partial,
    measure_scene,
    open_recording,
)
from tests.commands import refused, run
from tests.surface.coverage.tubes import grid_mesh, joined, pinhole, plane, sphere, tube, view_at

DEFAULTS = CoverageSettings()


def solid_angle(lens) -> float:
    """Solid angle of the image of a centred pinhole camera."""
    x, y = 0.5 * lens.width / lens.fx, 0.5 * lens.height / lens.fy
    return 4.0 * np.arctan(x * y / np.sqrt(1.0 + x * x + y * y))


def test_pixel_angles_add_up_to_the_field_of_view():
    lens = pinhole()
    for most in (500, 4000, 100_000):
        grid = RayGrid.of(lens, None, most)
        rays_per_pixel = len(grid.cells) / (lens.width * lens.height)
        assert len(grid.cells) <= max(most, 4 * lens.width * lens.height) * 1.05
        assert grid.pixel_angles.sum() / rays_per_pixel == pytest.approx(solid_angle(lens), rel=0.01)


def test_a_sphere_seen_from_its_centre():
    lens, radius = pinhole(), 30.0
    mesh = sphere(radius)
    views = see_faces(mesh, [view_at((0, 0, 0), (1, 0.2, 0.3), lens)], DEFAULTS)
    area = mesh.areas[views.seen].sum()
    # Triangles that the edge of the image crosses count whole.
    assert area == pytest.approx(solid_angle(lens) * radius**2, rel=0.06)
    assert np.allclose(views.distance[views.seen], radius, rtol=1e-3)
    assert views.incidence[views.seen].max() < 2.5
    assert views.frames.max() == 1 and (views.best_frame[views.seen] == 0).all() and (views.best_frame < 1).all()
    assert np.isnan(views.distance[~views.seen]).all() and np.isnan(views.brightness).all()
    # On the axis, a pixel of 1/f radians covers r / f of the surface.
    assert views.pixels_per_length[views.seen].min() == pytest.approx(lens.fx / radius, rel=0.02)


def test_two_frames_are_counted_and_the_best_of_each_measure_is_kept():
    mesh = plane(40.0, 5.0, 2.0)
    near, far = view_at((0, 0, 20), grey=20), view_at((0, 0, 0), grey=200)
    views = see_faces(mesh, [far, near], DEFAULTS)
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


def test_only_the_front_within_range_is_seen_and_a_mesh_is_turned_to_the_cameras():
    mesh, camera = plane(40.0, 5.0), [view_at((0, 0, 0))]
    assert see_faces(mesh, camera, CoverageSettings(max_distance=41.0)).seen.all()
    assert not see_faces(mesh, camera, CoverageSettings(max_distance=39.0)).seen.any()
    turned = TriangleMesh(mesh.vertices, mesh.triangles[:, ::-1])
    assert not see_faces(turned, camera, DEFAULTS).seen.any()
    assert np.array_equal(facing_cameras(turned, camera, DEFAULTS).triangles, mesh.triangles)
    assert facing_cameras(mesh, camera, DEFAULTS) is mesh


def test_masked_pixels_see_nothing():
    lens = pinhole()
    mask = np.zeros((lens.height, lens.width), bool)
    mask[:, : lens.width // 2] = True
    mesh = plane(40.0, 5.0, 1.0)
    visible = see_faces(mesh, [view_at((0, 0, 0), lens=lens, mask=mask)], DEFAULTS).seen
    assert visible[mesh.centers[:, 0] < -1.0].all() and not visible[mesh.centers[:, 0] > 1.0].any()


def test_levels_tell_a_glance_darkness_and_distance_apart():
    mesh, options = plane(40.0, 5.0, 2.0), CoverageSettings(glance_frames=2, far=50.0, dark=0.2, grazing=60.0)

    def level(*views):
        levels = np.unique(classify(see_faces(mesh, views, options), options))
        assert len(levels) == 1
        return Level(levels[0])

    good, dark, far = view_at((0, 0, 0), grey=100), view_at((0, 0, 0), grey=20), view_at((0, 0, -20), grey=100)
    slanted = view_at((60, 0, 15), (-60, 0, 25), grey=100, lens=pinhole(focal=200.0))
    near_slant = CoverageSettings(glance_frames=1, far=100.0, dark=0.2, grazing=60.0)
    assert level(good, good) == Level.SEEN_WELL
    assert level(good) == Level.GLANCE and level(good, dark) == Level.GLANCE
    assert level(dark, dark) == Level.POOR and level(far, far) == Level.POOR
    assert level(view_at((0, 0, 0), (0, 0, -1))) == Level.UNSEEN
    levels = classify(see_faces(mesh, [slanted], near_slant), near_slant)
    assert set(levels) == {Level.GLANCE}


def test_input_that_cannot_be_measured_is_refused():
    mesh = tube()
    with pytest.raises(InputError, match="no viewing ray"):
        facing_cameras(mesh, [view_at((0, 0, 500.0))], DEFAULTS)
    with pytest.raises(InputError, match="without frames"):
        facing_cameras(mesh, [], DEFAULTS)
    with pytest.raises(InputError, match="without triangles"):
        facing_cameras(mesh.part(np.zeros(len(mesh), bool)), [view_at((0, 0, 0))], DEFAULTS)
    with pytest.raises(InputError, match=r"setting far: .*got -3\.0"):
        validated(CoverageSettings, {"far": -3.0}, "setting")


def test_neighbours_share_edges_and_regions_are_what_is_connected():
    mesh = plane(0.0, 2.0, 1.0)
    pairs = neighbours(mesh)
    # 4 x 4 squares: a diagonal in each, and 2 * 4 * 3 inner edges.
    assert len(pairs) == 16 + 24
    left, right = mesh.centers[:, 0] < -1.0, mesh.centers[:, 0] > 1.0
    regions = large_regions(left | right, pairs, mesh.areas, 3.9)
    assert [len(region) for region in regions] == [8, 8]
    assert all(left[region].all() or right[region].all() for region in regions)
    assert large_regions(left, pairs, mesh.areas, 4.1) == []
    bridged = np.concatenate([pairs, near_pairs(mesh.centers, left, right, 3.0)])
    assert len(large_regions(left | right, bridged, mesh.areas, 0.0)) == 1
    assert len(near_pairs(mesh.centers, left, right, 0.5)) == 0
    assert len(near_pairs(mesh.centers, left, np.zeros(32, bool), 9.0)) == 0


FEW_RAYS = CoverageSettings(rays=20_000)


def path(*places: float, **options):
    """Cameras on the axis, looking deeper."""
    return [view_at((0.5, -0.3, z), name=f"z{z:g}", **options) for z in places]


def without(mesh: TriangleMesh, z: tuple[float, float], angle: tuple[float, float]) -> TriangleMesh:
    """The mesh with a window cut out, in mm along z and degrees from x to y."""
    x, y, depth = mesh.centers.T
    around = np.degrees(np.arctan2(y, x)) % 360.0
    cut = (depth > z[0]) & (depth < z[1]) & (around > angle[0]) & (around < angle[1])
    return mesh.part(~cut)


def poses(views):
    return np.stack([view.camera_to_world for view in views])


def test_the_centreline_of_a_cylinder_is_its_axis():
    mesh = tube(radius=10.0)
    line = find_centreline(mesh, poses(path(10.0, 0.0, 5.0)))
    assert np.abs(line.points[:, :2]).max() < 0.1
    assert np.allclose(line.frames[:, :, 2], [0, 0, 1], atol=0.02)
    assert line.points[0, 2] < -15.0 and line.points[-1, 2] > 75.0
    points = np.array([[0.0, -10.0, 30.0], [10.0, 0.0, -7.0], [0.0, 10.0, 0.0], [-4.0, 0.0, 12.25]])
    arc, clock, radius = line.unroll(points)
    # Images are upright: their up is -y, their right x; place 0 is at the shallowest camera.
    assert np.allclose(arc, points[:, 2], atol=1.0) and np.allclose(np.diff(arc), np.diff(points[:, 2]), atol=0.1)
    assert np.allclose(clock % 360.0, [0.0, 90.0, 180.0, 270.0], atol=1.0) or np.isclose(clock[0], 360.0, atol=1.0)
    assert np.allclose(radius, [10.0, 10.0, 10.0, 4.0], atol=0.1)


def test_places_count_from_the_shallowest_camera_also_where_it_is_before_the_wall():
    line = find_centreline(tube(radius=10.0, start=12.0), poses(path(0.0, 4.0, 8.0)))
    arc, _, _ = line.unroll(np.array([[0.0, 10.0, 30.0], [10.0, 0.0, 60.0]]))
    assert np.allclose(arc, [30.0, 60.0], atol=0.5)


def test_the_centreline_follows_a_bend_around_folds():
    turn, bend = np.linspace(0.0, np.pi / 2.0, 150), 50.0
    angle = np.arange(72) * (2.0 * np.pi / 72)
    size = 12.0 - 3.0 * np.exp(-(((turn[:, None] * bend) % 20.0 - 10.0) ** 2) / 4.0) * (1.0 + np.cos(angle)) / 2.0
    reach = bend + size * np.cos(angle)
    points = np.stack([bend - reach * np.cos(turn)[:, None], size * np.sin(angle), reach * np.sin(turn)[:, None]], -1)
    line = find_centreline(grid_mesh(points, around=True), poses([view_at((0.5, 0, 15), (0.3, 0, 1))]))
    off = np.hypot(np.hypot(line.points[:, 0] - bend, line.points[:, 2]) - bend, line.points[:, 1])
    assert off.max() < 2.0 and off.mean() < 1.0
    assert line.arc[-1] - line.arc[0] > 0.85 * bend * np.pi / 2.0


def test_behind_a_fold_the_guess_returns_to_the_wall():
    def fold(z, angle):
        return 18.0 - 8.0 * np.exp(-(np.abs((z - 30.0) / 1.5) ** 3)) * np.ones_like(angle)

    mesh = without(tube(radius=fold, spacing=0.5), (30.5, 45.0), (-1.0, 361.0))
    guess = guessed_wall(wall_around(mesh, find_centreline(mesh, poses(path(0.0, 5.0)))))
    beyond = (guess.vertices[:, 2] > 38.0) & (guess.vertices[:, 2] < 45.0)
    assert np.allclose(np.hypot(*guess.vertices[beyond, :2].T), 18.0, atol=1.5)


def test_missed_regions_of_a_hole_and_of_hidden_wall():
    """A hole of 12 mm by 60 degrees at 90 degrees from x to y, which is below: at six o'clock."""
    mesh = without(tube(radius=15.0), (30.0, 42.0), (60.0, 120.0))
    coverage = measure_coverage(mesh, path(0.0, 1.0, 2.0, 3.0, grey=100), FEW_RAYS)
    inner = [region for region in coverage.regions if not region.at_end]
    assert len(inner) == 1
    region = inner[0]
    assert region.area == pytest.approx(12.0 * 15.0 * np.pi / 3.0, rel=0.25)
    assert region.guessed_area == pytest.approx(region.area)
    assert region.arc == pytest.approx(36.0, abs=1.5) and region.clock == pytest.approx(180.0, abs=4.0)
    assert region.centroid == pytest.approx([0.0, 15.0, 36.0], abs=1.5)
    assert region.reach == pytest.approx((30.0, 42.0), abs=1.5)
    assert region.diameter == pytest.approx(2.0 * np.sqrt(region.area / np.pi))
    assert coverage.area(coverage.guessed) == pytest.approx(region.area, rel=0.01)
    wall = coverage.mesh.part(coverage.guessed)
    inside = np.abs(wall.vertices[:, 2] - 36.0) < 12.0
    assert np.allclose(np.hypot(*wall.vertices[inside, :2].T), 15.0, atol=0.1)
    assert ((wall.normals[:, :2] * -wall.centers[:, :2]).sum(axis=1) > 0.9 * 15.0).all()
    # What the corners of the image do not show where the section begins.
    assert all(other.reach[0] < coverage.section.start + 1.0 for other in coverage.regions if other.at_end)
    image = draw_map(coverage)
    assert image.dtype == np.uint8 and image.ndim == 3


def test_wall_behind_a_fold_is_missed_and_wall_before_it_is_seen():
    def fold(z, angle):
        return 18.0 - 8.0 * np.exp(-(((z - 40.0) / 1.2) ** 2)) * np.ones_like(angle)

    mesh = tube(radius=fold, end=110.0)
    views = path(0.0, 1.0, 2.0, 3.0, 4.0, grey=100, lens=pinhole(64, 64, 20.0))
    coverage = measure_coverage(mesh, views, CoverageSettings(rays=100_000))
    # From 4 mm, the crest of radius 10 at 40 mm hides wall up to 4 + 36 * 18 / 10 = 69 mm.
    ring = next(region for region in coverage.regions if not region.at_end)
    assert ring.reach[0] == pytest.approx(40.0, abs=1.5) and ring.reach[1] == pytest.approx(69.0, abs=4.0)
    assert ring.guessed_area == 0.0
    before = (coverage.arc > 25.0) & (coverage.arc < 35.0)
    assert coverage.views.seen[before].all() and (coverage.level[before] >= Level.GLANCE).all()


def test_a_section_ends_where_less_than_half_was_seen_but_not_at_a_gap_within_its_window():
    arc = np.repeat(np.arange(100) + 0.5, 4)
    areas = np.ones(400)
    share = np.tile(np.arange(4), 100)
    shown = (arc > 20.0) & (arc < 70.0)
    section = find_section(arc, areas, shown)
    assert (section.start, section.end) == pytest.approx((20.0, 70.0), abs=1.01)
    gap = shown & ~((arc > 40.0) & (arc < 60.0))
    assert find_section(arc, areas, gap) == section
    quarter = shown | ((arc >= 70.0) & (share == 0))
    assert find_section(arc, areas, quarter).end < 75.0
    assert section.holds(np.array([19.0, 45.0, 72.0])).tolist() == [False, True, False]
    with pytest.raises(NoLumenError, match="half of the wall"):
        find_section(arc, areas, np.zeros(400, bool))
    with pytest.raises(NoLumenError, match=r"along [1-9] mm only was half of the wall seen"):
        find_section(arc, areas, (arc > 40.0) & (arc < 46.0))


def test_of_a_wall_without_a_lumen_the_seen_area_remains():
    # The image of a camera 30 mm before a plane is 48 mm by 36 mm.
    coverage = measure_coverage(plane(30.0, 30.0), [view_at((0, 0, 0), grey=100)] * 2, FEW_RAYS)
    assert isinstance(coverage, PartialCoverage) and "centreline" in coverage.reason and coverage.metric
    assert coverage.area(coverage.level == Level.GLANCE) == pytest.approx(48.0 * 36.0, rel=0.02)
    assert coverage.area() == pytest.approx(60.0**2)
    picture = draw_partial(coverage, [view_at((0, 0, 0))] * 2)
    assert (picture == dict(MAP_LEGEND)["not seen"]).all(axis=-1).any()


def test_a_tube_of_unknown_unit_is_seen_at_any_distance():
    mesh, views = tube(), path(0.0, 1.0, 2.0, grey=100)
    scale = 1000.0
    far = [replace(view, camera_to_world=view.camera_to_world * np.array([1.0, 1.0, 1.0, scale])) for view in views]
    large = measure_coverage(TriangleMesh(scale * mesh.vertices, mesh.triangles), far, FEW_RAYS, metric=False)
    assert isinstance(large, PartialCoverage) and "unit" in large.reason and not large.metric
    small = measure_coverage(mesh, views, FEW_RAYS, metric=False)
    assert large.area() == pytest.approx(scale**2 * small.area())
    np.testing.assert_array_equal(large.level, small.level)


SMALL = {"seed": 3, "frames": 9, "rotation_views": 0, "supersampling": 1, "mesh_spacing": 3.0, "texture_spacing": 1.0}


def made(folder, layout, width):
    return make_phantom(
        folder / layout, layout=layout, width=width, height=80, interreflection=0.0, path_length=30.0, **SMALL
    )


@pytest.fixture(scope="module")
def phantom(tmp_path_factory):
    return made(tmp_path_factory.mktemp("coverage"), "c3vd", 96)


@pytest.fixture(scope="module", params=["c3vd", "c3vd-raw"])
def recorded(request, phantom, tmp_path_factory):
    """Also one through a lens that bends rays, with dark corners."""
    return phantom if request.param == "c3vd" else made(tmp_path_factory.mktemp("raw"), request.param, 100)


def true_mesh(phantom):
    return phantom / "truth" / "mesh.ply"


def test_hidden_pixels_see_nothing(recorded, tmp_path):
    scene = Path(shutil.copytree(recorded, tmp_path / "scene"))
    before = recorded_views(open_recording(recorded))[0]
    shown = np.arange(before.lens.width) >= 40
    for path in scene.rglob("*.png"):
        if (image := read_8_bit(path)).shape[:2] == (before.lens.height, before.lens.width):
            write_image(path, np.dstack([image, np.broadcast_to(np.uint8(255) * shown, image.shape[:2])]))
    mask = recorded_views(open_recording(scene))[0].mask
    np.testing.assert_array_equal(mask, np.broadcast_to(shown, mask.shape) & (before.mask is None or before.mask))


def test_the_true_mesh_has_its_true_coverage(recorded, tmp_path):
    """One ray at the centre of each pixel is what the truth of a phantom without supersampling is made of."""
    scene = open_recording(recorded)
    lens = recorded_views(scene)[0].lens
    # The truth counts wall at any distance.
    settings = CoverageSettings(rays=lens.width * lens.height, max_distance=500.0)
    mesh = read_mesh(true_mesh(recorded))
    measured = measure_scene(scene, mesh, tmp_path / "made", settings)
    true = np.load(recorded / "truth" / "mesh_seen.npz")["face_seen_by_any_frame"]
    in_view, areas = measured.coverage.level[~measured.coverage.guessed] != Level.UNSEEN, mesh.areas
    # Only triangles between the rays, seen by their centroids, differ.
    assert areas[true & ~in_view].sum() < 2e-3 * areas[~in_view].sum()
    assert areas[~true & ~in_view].sum() > 0.9 * areas[~true].sum()


def test_the_command_writes_a_folder(phantom, tmp_path, capsys):
    # Wall that nobody saw is cut out, as in a reconstruction.
    in_view = np.load(phantom / "truth" / "mesh_seen.npz")["face_seen_by_any_frame"]
    wall, out = tmp_path / "wall.ply", tmp_path / "out"
    write_mesh(wall, read_mesh(true_mesh(phantom)).part(in_view))
    assert run("coverage", phantom, "--mesh", wall, "--output", out, "--set", "rays=8000") == 0
    printed = capsys.readouterr().out
    assert RESEARCH_USE in printed and printed.splitlines()[-1] == f"written: {out}"
    values = json.loads((out / "coverage.json").read_text())
    assert sum(values["shares"].values()) == pytest.approx(1.0)
    assert values["guessed_share"] > 0.05 and values["note"] == RESEARCH_USE
    rows = list(csv.DictReader((out / "regions.csv").open()))
    areas = [region["area"] for region in values["regions"]]
    assert [float(row["area_mm2"]) for row in rows] == pytest.approx(areas, abs=1e-3)
    assert len(rows) >= 1 and all(float(row["diameter_mm"]) > 5.0 for row in rows)
    page = (out / "coverage.html").read_text()
    assert RESEARCH_USE in page and "http" not in page.replace("http://www.w3.org", "")
    assert (out / "map.png").is_file() and read_mesh(out / "coverage.ply").colors is not None
    # Wall that any frame shows is seen, and a smaller part of it seen well: two numbers under two names everywhere.
    shares = values["shares"]
    assert 0.0 < shares["seen_well"] < values["seen"] == pytest.approx(1.0 - shares["unseen"])
    for name, share in (("seen", values["seen"]), ("seen well", shares["seen_well"])):
        assert f"<dt>{name}</dt><dd>{100.0 * share:.0f} % of the wall</dd>" in page
        assert re.search(rf"^{name} +{100.0 * share:.0f} % of the wall$", printed, re.MULTILINE)
    assert f"seen well</th><td><span>{shares['seen_well'] * values['area'] / 100.0:.1f} cm²" in page
    assert "already exists" in refused(capsys, "coverage", phantom, "--mesh", wall, "--output", out)


def test_bad_input_is_one_clear_error(phantom, tmp_path, capsys):
    mesh, out = true_mesh(phantom), tmp_path / "out"
    for arguments, message in (
        ((phantom,), "is not a run folder"),
        ((phantom, "--mesh", tmp_path / "none.ply", "--output", out), "none.ply"),
        ((phantom, "--mesh", mesh, "--output", out, "--set", "farr=3"), "'farr'"),
        ((tmp_path / "gone", "--mesh", mesh, "--output", out), "gone"),
    ):
        assert message in refused(capsys, "coverage", *arguments), arguments
    assert not out.exists()


def test_of_a_short_video_the_seen_wall_is_written_and_why_there_is_no_section(phantom, tmp_path, capsys):
    # A patch of the wall before the first camera is no tube.
    scene, whole = open_recording(phantom), read_mesh(true_mesh(phantom))
    camera = recorded_views(scene)[0]
    local = (whole.centers - camera.center) @ camera.camera_to_world[:3, :3]
    wall, out = tmp_path / "wall.ply", tmp_path / "out"
    write_mesh(wall, whole.part((local[:, 0] > 5.0) & (local[:, 2] > 5.0) & (local[:, 2] < 25.0)))
    assert run("coverage", phantom, "--mesh", wall, "--output", out, "--set", "rays=8000") == 0
    printed = capsys.readouterr().out
    values = json.loads((out / "coverage.json").read_text())
    assert values["unit"] == "mm" and 0.0 < values["seen_area"] <= values["area"] and sum(values["shares"].values())
    assert (
        f"none ({values['no_section']})" in printed and values["section"] is values["regions"] is values["seen"] is None
    )
    page = (out / "coverage.html").read_text()
    assert html.escape(values["no_section"]) in page.replace("&#39;", "&#x27;") and RESEARCH_USE in page
    assert {file.name for file in out.iterdir()} == {"coverage.html", "coverage.json", "coverage.ply", "map.png"}


@pytest.mark.thorough
def test_a_scene_of_unknown_unit_has_its_areas_in_square_units(phantom, tmp_path):
    scene = replace(open_recording(phantom), provenance=Provenance(unit="unknown"))
    measured = measure_scene(scene, read_mesh(true_mesh(phantom)), tmp_path / "out", CoverageSettings(rays=8000))
    assert measured.values["unit"] == "unknown" and measured.values["settings"]["far"] is None
    assert "square units" in measured.summary and "unit of length is unknown" in measured.values["no_section"]
