"""C3VD as prepared by EndoGSLAM, and PR-Endo's release of it, with an ideal result (docs/layouts/c3vd-endogslam.md)."""

from __future__ import annotations

import numpy as np

from coliags_plugin.core.arrays import read_arrays
from coliags_plugin.core.files import write_arrays
from coliags_plugin.core.images import write_image
from coliags_plugin.core.ply import point_properties, write_ply
from coliags_plugin.datamanagers.c3vd_endogslam import OPTIMIZED, PARAMS, PREPARED_DEPTH, PREPARED_PINHOLE, SH0
from coliags_plugin.geometry.lenses.models import PinholeLens
from coliags_plugin.geometry.poses import endogslam
from coliags_plugin.geometry.poses.trajectory import Trajectory, inverse
from coliags_plugin.phantom.layouts import TEST_EVERY, Layout, part_folder, write_poses

#: Folder and scene of PR-Endo's release, and the iteration of its Gaussians.
_DATA, _SCENE, _ITERATION = "C3VD", "phantom", 30_000
#: Standard deviation of the map's Gaussians, mm.
_SIZE = 0.3


class EndoGSLAMLayout(Layout):
    """color/, 8-bit depth/, pose.txt, and params.npz of an ideal EndoGSLAM run on the training frames."""

    name = "endogslam"
    default_size = (PREPARED_PINHOLE.width, PREPARED_PINHOLE.height)
    has_rotation = True
    has_points = True

    def is_test(self, index):
        """EndoGSLAM's: 7, 15, 23, ..."""
        return index % TEST_EVERY == TEST_EVERY - 1

    def lens(self, width, height):
        """EndoGSLAM's camera of undistorted frames, scaled to the size. All pixels are lit."""
        return PinholeLens.of(PREPARED_PINHOLE.resized(width, height)), np.ones((height, width), bool)

    def write_frame(self, folder, frame):
        folder = part_folder(folder, frame.part)
        steps = np.clip(np.floor(frame.z_depth / PREPARED_DEPTH.size), 0.0, 255.0).astype(np.uint8)
        write_image(folder / "color" / f"{frame.index:04d}_color.png", frame.color)
        write_image(folder / "depth" / f"{frame.index:04d}_depth.tiff", steps)

    def write_sequence(self, folder, part, poses, lens):
        write_poses(part_folder(folder, part) / "pose.txt", poses)

    def write_points(self, folder, points, poses, lens):
        training = [index for index in range(len(poses)) if not self.is_test(index)]
        _write_params(folder / PARAMS, Trajectory(poses[training], intrinsics=lens.pinhole), points)


class PREndoLayout(EndoGSLAMLayout):
    """C3VD/phantom without poses, and the result of an ideal EndoGSLAM run on all frames, also as a 3DGS PLY."""

    name = "pr-endo"
    has_rotation = False

    def write_frame(self, folder, frame):
        super().write_frame(folder / _DATA / _SCENE, frame)

    def write_sequence(self, folder, part, poses, lens):
        """Poses are in params.npz."""

    def write_points(self, folder, points, poses, lens):
        results = folder / f"{_DATA}{OPTIMIZED}" / _SCENE
        means = _write_params(results / PARAMS, Trajectory(poses, intrinsics=lens.pinhole), points)
        cloud = results / "point_cloud" / f"iteration_{_ITERATION}" / "point_cloud.ply"
        _write_gaussians(cloud, means, points.colors)

    def seen_mask(self, folder, part, index):
        """Path in the scene's folder, beside the images."""
        return super().seen_mask(folder / _DATA / _SCENE, part, index)


def _write_params(path, trajectory, points):
    """Write ``params.npz`` like EndoGSLAM, with given poses and an isotropic Gaussian at every point.

    The map's points are returned in EndoGSLAM's world, that of the first camera, mm.
    """
    endogslam.write(path, trajectory)
    arrays = read_arrays(path, "what was just written", optional=None)
    to_first = inverse(trajectory.camera_to_world[:1])[0]
    means = points.positions @ to_first[:3, :3].T + to_first[:3, 3]
    count = len(means)
    arrays |= {
        "means3D": means.astype(np.float32),
        "rgb_colors": (points.colors / 255.0).astype(np.float32),
        "unnorm_rotations": np.tile(np.array([1.0, 0.0, 0.0, 0.0], np.float32), (count, 1)),
        "logit_opacities": np.full((count, 1), 4.0, np.float32),
        "log_scales": np.full((count, 1), np.log(_SIZE), np.float32),
        "timestep": np.zeros(count, np.float32),
    }
    write_arrays(path, arrays)
    return np.asarray(means)


def _write_gaussians(path, positions, colors):
    """Write isotropic Gaussians of equal size as a 3DGS PLY file of spherical-harmonics degree 0."""
    count = len(positions)
    properties = point_properties(positions)
    properties |= {f"n{name}": np.zeros(count) for name in "xyz"}
    properties |= {f"f_dc_{channel}": (colors[:, channel] / 255.0 - 0.5) / SH0 for channel in range(3)}
    properties |= {"opacity": np.full(count, 4.0)}
    properties |= {f"scale_{axis}": np.full(count, -1.2) for axis in range(3)}
    properties |= {f"rot_{axis}": np.full(count, float(axis == 0)) for axis in range(4)}
    write_ply(path, properties)
