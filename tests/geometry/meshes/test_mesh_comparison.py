"""Comparison of surfaces: closed forms, and open3d's own measures."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import open3d
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from coliags_plugin.core.errors import InputError
from coliags_plugin.geometry.meshes.mesh import TriangleMesh
from coliags_plugin.geometry.meshes.truth import TrueSurface, angles_between, compare_meshes, sample_surface
from tests.surface.coverage.tubes import plane as square

COUNT = 40_000


def plane(z: float = 0.0, size: float = 40.0) -> TriangleMesh:
    """A square about the origin, in 20 x 20 cells."""
    return square(z, size / 2, size / 20)


def sphere(radius: float) -> TriangleMesh:
    made = open3d.geometry.TriangleMesh.create_sphere(radius, 80)
    return TriangleMesh(np.asarray(made.vertices, np.float32), np.asarray(made.triangles).astype(np.int64))


def true(mesh: TriangleMesh, seen: np.ndarray | None = None) -> TrueSurface:
    return TrueSurface(Path("truth"), mesh, np.ones(len(mesh), bool) if seen is None else seen, "all")


def test_a_shifted_plane():
    compared = compare_meshes(plane(0.75), true(plane()), COUNT)
    for direction in (compared.accuracy, compared.completeness):
        assert (direction.mean, direction.median, direction.percentile_95) == pytest.approx((0.75,) * 3, abs=1e-5)
    assert (compared.chamfer, compared.hausdorff_95) == pytest.approx((0.75, 0.75), abs=1e-5)
    assert [score.f for score in compared.scores] == [0.0, 1.0, 1.0]  # nothing within 0.5 mm
    assert compared.normal_error == pytest.approx(0.0, abs=0.1)
    assert compared.beyond_seen == 0.0
    assert compared.seen_area == pytest.approx(1600.0)


def test_missing_surface_costs_recall_and_invented_surface_precision():
    left = plane().part(plane().centers[:, 0] < 0)
    missing = compare_meshes(left, true(plane()), COUNT).scores[1]
    # What lies within 1 mm of the edge at x = 0 still counts.
    assert (missing.precision, missing.recall) == (1.0, pytest.approx(21 / 40, abs=1e-3))
    invented = compare_meshes(plane(), true(left), COUNT).scores[1]
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
    compared = compare_meshes(replace(turned, vertices=vertices), true(plane()), COUNT)
    assert compared.normal_error == pytest.approx(5.0, abs=0.01)
    assert compared.accuracy.mean == pytest.approx(2.5 * np.sin(angle), rel=1e-3)


def test_sides_do_not_matter_for_angles():
    up = np.array([[0.0, 0, 1]])
    assert angles_between(up, -up) == pytest.approx([0.0])
    assert angles_between(up, np.array([[0.0, 1, 0]])) == pytest.approx([90.0])


def test_open3d_agrees():
    """Its point-to-point measures of dense samples are ours, up to the spacing of the samples."""
    generator = np.random.default_rng(5)
    mesh = sphere(20.0)
    rough = replace(mesh, vertices=mesh.vertices + generator.normal(0, 0.5, mesh.vertices.shape).astype(np.float32))
    metrics = open3d.t.geometry.Metric
    options = open3d.t.geometry.MetricParameters(fscore_radius=[0.5, 1.0, 2.0], n_sampled_points=COUNT)
    chosen = [metrics.ChamferDistance, metrics.FScore]
    chamfer, *fs = rough.to_open3d().compute_metrics(mesh.to_open3d(), chosen, options).numpy()
    compared = compare_meshes(rough, true(mesh), COUNT)
    assert 2 * compared.chamfer == pytest.approx(chamfer, abs=0.12)
    assert [100 * score.f for score in compared.scores] == pytest.approx(fs, abs=3.0)


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
    with pytest.raises(InputError, match="without area"):
        sample_surface(mesh, 10, np.zeros(len(mesh), bool))


@pytest.mark.parametrize(("factor", "shift"), [(0.001, 0), (1000, 0), (1, 60)])
def test_another_unit_or_world_is_refused(factor, shift):
    mesh = replace(plane(), vertices=plane().vertices + np.float32([30, 0, 20]))
    other = replace(mesh, vertices=np.float32(factor) * mesh.vertices + np.float32(shift))
    with pytest.raises(InputError, match="one world and unit"):
        compare_meshes(other, true(mesh), COUNT)
