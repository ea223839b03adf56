"""The image of two trajectories."""

from __future__ import annotations

import numpy as np
import pytest

from coliags_plugin.geometry.poses.alignment import align
from coliags_plugin.geometry.poses.association import associate
from coliags_plugin.geometry.poses.trajectory import Trajectory
from coliags_plugin.outputs.trajectory_plot import ESTIMATE_RGB, REFERENCE_RGB, plot_trajectory
from tests.geometry.poses.winding import winding

#: The two views, above the charts: rows, then columns of each.
VIEWS = slice(71, 500), (slice(71, 580), slice(671, 1180))


def plot_of(estimate, reference, unit="mm"):
    return plot_trajectory(align(estimate, reference, associate(estimate, reference)), unit)


def places(view, color):
    """Where a hue is, smoothed lines included: their pixels lie between the colour and white."""
    ink, full = 255.0 - view, 255.0 - np.array(color)
    share = ink @ full / (full @ full)
    return np.argwhere((share > 0.3) & (np.abs(ink - share[..., None] * full).max(axis=2) < 12.0))


def test_paths_lie_where_their_axes_say():
    """A path along +x and +y only: up in the view from above, down in the view from the side."""
    poses = np.tile(np.eye(4), (9, 1, 1))
    poses[:, 0, 3] = poses[:, 1, 3] = np.linspace(0.0, 20.0, 9)
    poses[:, 2, 3] = np.linspace(0.0, 20.0, 9)
    poses[4, 0, 3] += 1.0
    reference = Trajectory(poses)
    image = plot_of(reference, reference)
    assert image.shape == (900, 1200, 3)
    assert image.dtype == np.uint8
    for columns, rises in zip(VIEWS[1], (True, False), strict=True):
        found = places(image[VIEWS[0], columns], ESTIMATE_RGB)
        first, last = found[found[:, 1].argmin()], found[found[:, 1].argmax()]
        assert (last[0] < first[0]) == rises


def test_the_larger_circle_is_the_references_and_both_are_drawn():
    reference = winding(15)
    shifted = reference.camera_to_world.copy()
    shifted[3:, :3, 3] += (3.0, -2.0, 1.0)
    image = plot_of(Trajectory(shifted), reference)
    for columns in VIEWS[1]:
        view = image[VIEWS[0], columns]
        assert len(places(view, REFERENCE_RGB)) > len(places(view, ESTIMATE_RGB)) > 50


@pytest.mark.parametrize("motion", [0.0, 30.0])
def test_an_image_is_drawn_for_straight_paths_and_none(motion):
    poses = np.tile(np.eye(4), (5, 1, 1))
    poses[:, 2, 3] = np.linspace(0.0, motion, 5)
    image = plot_of(Trajectory(poses), Trajectory(poses))
    assert (image != 255).any()
    assert len(places(image[585:700], ESTIMATE_RGB))
    assert len(places(image[745:860], ESTIMATE_RGB))
