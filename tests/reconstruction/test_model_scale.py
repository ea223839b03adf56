"""Scale of a model from a diameter or a distance."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pycolmap
import pytest

from coliags_plugin.core.errors import InputError
from coliags_plugin.geometry.poses.rigid import rigid
from coliags_plugin.reconstruction.structure.model_scale import distances_beside, from_diameter, from_distance, scaled
from coliags_plugin.reconstruction.structure.sfm import Reconstruction

RADIUS = 2.5


def tube(length=20.0, ahead=10.0):
    """A camera on the axis of a tube whose wall reaches ahead of it and behind."""
    rng = np.random.default_rng(0)
    z, turn = rng.uniform(-ahead, length + ahead, 400), rng.uniform(0, 2 * np.pi, 400)
    model = pycolmap.Reconstruction()
    for point in np.column_stack([RADIUS * np.cos(turn), RADIUS * np.sin(turn), z]):
        model.add_point3D(point, pycolmap.Track(), np.zeros(3, np.uint8))
    centers = np.column_stack([np.zeros((5, 2)), np.linspace(0.0, length, 5)])
    images = tuple(Path(f"folder/{index}.png") for index in range(6))
    poses = rigid(np.tile(np.eye(3), (5, 1, 1)), centers)
    return Reconstruction(images, tuple(range(5)), poses, tuple(path.name for path in images), model, (5,))


def test_the_diameter_is_that_of_the_wall_beside_the_path():
    assert from_diameter(tube(), 45.0) == pytest.approx(45.0 / (2 * RADIUS))
    with pytest.raises(InputError, match=r"points lie beside the camera's path. Expected at least 30"):
        from_diameter(tube(length=0.5), 45.0)


def test_distances_from_a_bent_path():
    path = np.array([(0, 0, 0), (10, 0, 0), (10, 10, 0)], float)
    points = np.array([(5, 0, 3), (10, 5, -4), (12, -2, 1), (-1, 0, 2), (10, 11, 0)], float)
    np.testing.assert_allclose(distances_beside(path, points), [3.0, 4.0, 3.0])


def test_a_known_distance():
    assert from_distance(tube(), "0.png", "4", 100.0) == pytest.approx(5.0)
    with pytest.raises(InputError, match=r"no image '5.png' with a pose"):
        from_distance(tube(), "0.png", "5.png", 1.0)
    with pytest.raises(InputError, match="coincide"):
        from_distance(tube(), "0.png", "0", 1.0)


def test_scaled_models_have_scaled_points_and_positions():
    before = tube()
    after = scaled(before, 4.0)
    np.testing.assert_allclose(after.camera_to_world[:, :3, 3], 4.0 * before.camera_to_world[:, :3, 3])
    np.testing.assert_array_equal(after.camera_to_world[:, :3, :3], before.camera_to_world[:, :3, :3])
    for number, point in before.model.points3D.items():
        np.testing.assert_allclose(after.model.points3D[number].xyz, 4.0 * point.xyz)
