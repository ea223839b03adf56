"""Layouts of public datasets, in which phantoms are written here so that their readers have something to read.

Every subclass of Layout with a ``name`` in this module is registered.
"""

from __future__ import annotations

import math

import numpy as np
import OpenEXR

from coliags_plugin.core.arrays import read_arrays
from coliags_plugin.core.files import atomic_write, write_arrays, write_json
from coliags_plugin.core.images import write_image, write_mask
from coliags_plugin.core.ply import point_properties, write_ply
from coliags_plugin.core.registry import phantom_layouts
from coliags_plugin.core.scene_files import write_unit
from coliags_plugin.datamanagers.c3vd import CANDIDATE_LENS, INTRINSICS, ORDER
from coliags_plugin.datamanagers.c3vd_endogslam import OPTIMIZED, PARAMS, PREPARED_DEPTH, PREPARED_PINHOLE, SH0
from coliags_plugin.datamanagers.reim_nerf import C3VD_RANGE, MASK_FILE, PARTS, ray_cosines
from coliags_plugin.datamanagers.rotatecolon import POINTS, TEST, TRAIN, TRAIN_DEPTH, TRAIN_VIEWS
from coliags_plugin.geometry.lenses.models import LENSES, FisheyeLens, PinholeLens, octagon_mask
from coliags_plugin.geometry.lenses.vicalib import TYPE
from coliags_plugin.geometry.poses import endogslam, tum
from coliags_plugin.geometry.poses.trajectory import FLIP_Y_AND_Z, Trajectory, inverse
from coliags_plugin.phantom.layouts import DEPTH_SCALE, TEST_EVERY, Layout, depth_steps, part_folder, write_poses

# C3VD's release and C3VDv2 (docs/layouts/c3vd.md, docs/layouts/c3vd-v2.md)


class C3VDRawLayout(Layout):
    """The release's files: distorted frames with black corners, TIFF depth, pose.txt."""

    name = "c3vd-raw"
    default_size = (1350, 1080)
    has_rotation = True

    def lens(self, width, height):
        return LENSES["omnidirectional"].resized(width, height), octagon_mask(width, height)

    def write_frame(self, folder, frame):
        folder, number = part_folder(folder, frame.part), f"{frame.index:04d}"
        write_image(folder / f"{number}_color.png", frame.color)
        write_image(folder / f"{number}_depth.tiff", depth_steps(frame.z_depth))

    def write_sequence(self, folder, part, poses, lens):
        write_poses(part_folder(folder, part) / "pose.txt", poses)


class C3VDv2Layout(C3VDRawLayout):
    """Distorted frames with black corners in folders by kind, pose.txt, and the lens in camera_intrinsics.txt."""

    name = "c3vd-v2"

    def lens(self, width, height):
        return CANDIDATE_LENS.resized(width, height), octagon_mask(width, height)

    def write_frame(self, folder, frame):
        folder, number = part_folder(folder, frame.part), f"{frame.index:04d}"
        write_image(folder / "rgb" / f"{number}.png", frame.color)
        write_image(folder / "depth" / f"{number}_depth.tiff", depth_steps(frame.z_depth))

    def write_sequence(self, folder, part, poses, lens):
        super().write_sequence(folder, part, poses, lens)
        candidate = CANDIDATE_LENS
        values = {"a1": 0.0, **vars(candidate), "cx": candidate.cx - 0.5, "cy": candidate.cy - 0.5}
        atomic_write(folder / INTRINSICS, "".join(f"{name} = {values[name]!r}\n" for name in ORDER))


# C3VD as prepared by EndoGSLAM, and PR-Endo's release of it, with an ideal result (docs/layouts/c3vd-endogslam.md)


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
        return index % TEST_EVERY == TEST_EVERY - 1

    def lens(self, width, height):
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
    count = len(positions)
    properties = point_properties(positions)
    properties |= {f"n{name}": np.zeros(count) for name in "xyz"}
    properties |= {f"f_dc_{channel}": (colors[:, channel] / 255.0 - 0.5) / SH0 for channel in range(3)}
    properties |= {"opacity": np.full(count, 4.0)}
    properties |= {f"scale_{axis}": np.full(count, -1.2) for axis in range(3)}
    properties |= {f"rot_{axis}": np.full(count, float(axis == 0)) for axis in range(4)}
    write_ply(path, properties)


# A simulated sequence of EndoMapper (docs/layouts/endomapper.md)


CALIBRATION = "calibration.xml"
#: Like a colonoscope's: 150 degrees of view across the frame.
_LENS = FisheyeLens(width=1440, height=1080, fx=720.0, fy=720.0, cx=730.0, cy=550.0, k1=-0.14, k2=0.0, k3=0.0, k4=0.0)
#: Largest angle from the optical axis that is lit, degrees.
_LIT = 75.0


class EndoMapperLayout(Layout):
    """Fisheye images, depth and masks named by number, trajectory.txt and calibration.xml."""

    name = "endomapper"
    default_size = (1440, 1080)

    def lens(self, width, height):
        lens = _LENS.resized(width, height)
        column, row = np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5)
        rays = lens.unproject(np.stack([column.ravel(), row.ravel()], axis=1))
        lit = np.linalg.norm(rays, axis=1) <= 1.0 / np.cos(np.radians(_LIT))
        return lens, lit.reshape(height, width)

    def write_frame(self, folder, frame):
        height, width = frame.z_depth.shape
        _, lit = self.lens(width, height)
        name = f"{frame.index:04d}.png"
        write_image(folder / "rgb" / name, frame.color)
        write_image(folder / "depth" / name, depth_steps(frame.z_depth, DEPTH_SCALE, 0))
        write_mask(folder / "mask" / name, lit)

    def write_sequence(self, folder, part, poses, lens):
        tum.write(folder / "trajectory.txt", Trajectory(poses, timestamps=np.arange(len(poses), dtype=np.float64)))
        atomic_write(folder / CALIBRATION, calibration_text(lens, DEPTH_SCALE))
        write_unit(folder, "mm")


def calibration_text(lens, depth_scale=None):
    """A calibration file of Vicalib: pixel centres at integers, and perhaps depth steps per scene unit."""
    k = lens.pinhole
    params = (k.fx, k.fy, k.cx - 0.5, k.cy - 0.5, lens.k1, lens.k2, lens.k3, lens.k4)
    scale = "" if depth_scale is None else f"      <depth_scale> {depth_scale!r} </depth_scale>\n"
    return (
        "<rig>\n  <camera>\n"
        f'    <camera_model name="" index="0" serialno="0" type="{TYPE}" version="8">\n'
        f"      <width> {lens.width} </width>\n      <height> {lens.height} </height>\n"
        f"      <params> [ {'; '.join(map(repr, params))} ] </params>\n{scale}"
        "    </camera_model>\n  </camera>\n</rig>\n"
    )


# REIM-NeRF's preprocessed C3VD (docs/layouts/reim-nerf.md)


#: Normalised units per mm. REIM-NeRF's own are 0.0092 to 0.0229, so that a scene lies between -1 and 1.
SCENE_SCALE = 0.0095
#: Normalised distance of the stored value 65535.
DISTMAP_SCALE = math.pi
#: The scene's middle, mm ahead of the path's.
_AHEAD = 30.0


class ReimNerfLayout(Layout):
    """Circular fisheye images, distance maps, rgb_mask.png, and a JSON file per part."""

    name = "reim-nerf"
    default_size = (1350, 1080)

    def lens(self, width, height):
        lens = LENSES["fisheye"].resized(width, height)
        # Its preprocessing counts pixel centres at integers.
        cx, cy = lens.pinhole.cx - 0.5, lens.pinhole.cy - 0.5
        radius = max(min(cx, width - cx), min(cy, height - cy)) - 20.0 * width / 1350.0
        column, row = np.meshgrid(np.arange(width), np.arange(height))
        return lens, np.hypot(column - cx, row - cy) <= radius

    def is_test(self, index):
        """All but REIM-NeRF's training frames, its validation frames among them."""
        return index % 5 != 0 or _validates(index)

    def write_frame(self, folder, frame):
        clipped = np.minimum(frame.z_depth.astype(np.float64), C3VD_RANGE)
        height, width = clipped.shape
        cosines = ray_cosines(LENSES["fisheye"].resized(width, height)).astype(np.float64)
        distance = np.divide(clipped, cosines, out=np.zeros_like(clipped), where=cosines > 0.0)
        steps = np.rint(distance * (SCENE_SCALE / DISTMAP_SCALE * 65535.0))
        stored = np.clip(steps, 0.0, 65535.0).astype(np.uint16)
        write_image(folder / "images" / _name(frame.index), frame.color)
        write_image(folder / "distmaps" / _name(frame.index), stored)

    def write_sequence(self, folder, part, poses, lens):
        _, lit = self.lens(lens.width, lens.height)
        write_image(folder / MASK_FILE, np.where(lit, 0, 255).astype(np.uint8))
        shift = -(poses[:, :3, 3] + _AHEAD * poses[:, :3, 2]).mean(axis=0)
        to_middle = np.eye(4)
        to_middle[:3, 3] = shift
        frames = []
        for index, pose in enumerate(poses):
            normalised = pose @ FLIP_Y_AND_Z
            normalised[:3, 3] = (normalised[:3, 3] + shift) * SCENE_SCALE
            names = {"file_path": f"images/{_name(index)}", "distmap_path": f"distmaps/{_name(index)}"}
            frames.append({**names, "transform_matrix": normalised.tolist()})
        camera = {**_camera(lens), "scene_T": to_middle.tolist()}
        for name in PARTS:
            held = [frame for index, frame in enumerate(frames) if name in _parts_of(index)]
            write_json(folder / f"transforms_{name}.json", {**camera, "frames": held})


def _camera(lens):
    k = lens.pinhole
    return {
        "camera_model": "FISHEYE_OPENCV",
        # Pixel centres at integers, as OpenCV calibrates.
        **{"fx": k.fx, "fy": k.fy, "cx": k.cx - 0.5, "cy": k.cy - 0.5},
        **{"k1": lens.k1, "k2": lens.k2, "k3": lens.k3, "k4": lens.k4, "p1": 0.0, "p2": 0.0},
        "w": lens.width,
        "h": lens.height,
        "scene_scale": SCENE_SCALE,
        "dist_ftype": "png",
        "distmap": True,
        "rgb_mask": MASK_FILE,
        "distmap_scale": DISTMAP_SCALE,
    }


def _validates(index):
    return index % 25 == 0 and index > 0


def _parts_of(index):
    """REIM-NeRF's split: every fifth frame trains, of those every fifth but the first validates; all are ``test``."""
    if index % 5:
        return "test", "true_test"
    return "test", "val" if _validates(index) else "train"


def _name(index):
    return f"{index:04d}_color.png"


# RotateColon: Blender's views and EXR depth (docs/layouts/rotatecolon.md)


_TEST_VIEWS = "test_views_1"
#: Stored depth per mm, as in the dataset, and Blender's depth of the background.
_DEPTH_FACTOR, _BACKGROUND = 1.4, 1e10
#: Horizontal field of view, radians: that of C3VD's undistorted frames.
_ANGLE = 2.0 * math.atan(169.0 / 200.8769)


class RotateColonLayout(Layout):
    """Blender's files: training views with EXR depth, and rotated test views without depth."""

    name = "rotatecolon"
    has_rotation = True
    has_points = True

    def is_test(self, index):
        return False

    def lens(self, width, height):
        focal = 0.5 * width / math.tan(0.5 * _ANGLE)
        lens = PinholeLens(focal, focal, 0.5 * width, 0.5 * height, width, height)
        return lens, np.ones((height, width), bool)

    def write_frame(self, folder, frame):
        views = _TEST_VIEWS if frame.part == "rotation" else TRAIN_VIEWS
        write_image(folder / views / f"{frame.index:04d}.png", frame.color)
        if frame.part == "video":
            linear = ((frame.color / 255.0) ** 2.2).astype(np.float16)
            channels = {f"ViewLayer.Combined.{name}": linear[..., at].copy() for at, name in enumerate("RGB")}
            channels["ViewLayer.Combined.A"] = np.ones(frame.z_depth.shape, np.float16)
            depth = np.where(frame.z_depth > 0.0, frame.z_depth * _DEPTH_FACTOR, _BACKGROUND).astype(np.float32)
            write_exr(folder / TRAIN_DEPTH / f"{frame.index:04d}.exr", {**channels, "ViewLayer.Depth.Z": depth})

    def write_sequence(self, folder, part, poses, lens):
        frames = [
            {"file_path": str(index), "transform_matrix": (pose @ FLIP_Y_AND_Z).tolist()}
            for index, pose in enumerate(poses)
        ]
        write_json(folder / (TEST if part == "rotation" else TRAIN), {"camera_angle_x": _ANGLE, "frames": frames})
        write_unit(folder, "mm")

    def write_points(self, folder, points, poses, lens):
        write_ply(folder / POINTS, point_properties(points.positions, points.colors))

    def seen_mask(self, folder, part, index):
        return folder / "truth" / "seen" / f"{index:04d}_seen.png"


def write_exr(path, channels):
    """Write float channels [H, W] by their full names."""
    path.parent.mkdir(parents=True, exist_ok=True)
    OpenEXR.File({"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}, channels).write(str(path))


for kind in [*vars().values()]:
    if isinstance(kind, type) and issubclass(kind, Layout) and kind.__module__ == __name__:
        phantom_layouts.register(kind.name, f"{__name__}:{kind.__name__}", source="tests")
