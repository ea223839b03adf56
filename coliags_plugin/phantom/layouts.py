"""The folder layouts a phantom can be written in (docs/layouts): C3VD's, COLMAP's, nerfstudio's and TUM's.

To add one, subclass :class:`Layout` in a module of its own and register it in
:data:`coliags_plugin.core.registry.phantom_layouts`.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar, Literal, NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int, UInt8, UInt16

from coliags_plugin.core.files import atomic_write, write_json
from coliags_plugin.core.images import write_image
from coliags_plugin.core.intrinsics import Intrinsics
from coliags_plugin.core.scene_files import write_camera_json, write_unit
from coliags_plugin.geometry.lenses.models import FisheyeLens, Lens, OpenCVLens, PinholeLens
from coliags_plugin.geometry.poses import tum
from coliags_plugin.geometry.poses.c3vd import matrix_lines
from coliags_plugin.geometry.poses.colmap import colmap_poses, posed_model, write_reconstruction
from coliags_plugin.geometry.poses.trajectory import FLIP_Y_AND_Z, Trajectory, inverse

if TYPE_CHECKING:
    import pycolmap

#: ``video``: the sequence itself. ``rotation``: the rotated test views at its positions.
Part = Literal["video", "rotation"]

#: Interval of held-out test frames.
TEST_EVERY = 8

#: Intrinsics of C3VD's undistorted frames (docs/phantom.md 3); the calibration counts from integers, hence + 0.5.
_C3VD_PINHOLE = Intrinsics(200.8769, 200.4713, 167.3190 + 0.5, 136.9333 + 0.5, 338, 270)


@dataclass(frozen=True)
class PhantomFrame:
    """One frame of a phantom."""

    part: Part
    index: int  # within its part, from 0
    color: UInt8[np.ndarray, "H W 3"]  # RGB
    z_depth: Float[np.ndarray, "H W"]  # mm; 0 where there is no wall


@dataclass(frozen=True)
class WallPoints:
    """Points of the wall that training frames see, as a stand-in for structure-from-motion points."""

    positions: Float[np.ndarray, "N 3"]  # world, mm
    colors: UInt8[np.ndarray, "N 3"]  # RGB from a training frame
    seen_in: Callable[[int], Bool[np.ndarray, "N"]]  # those that a frame of the sequence sees, by its index


class Layout(ABC):
    """Interface of a folder layout that a phantom is written in: the files of a data format (docs/layouts).

    A folder is written in this order: every frame of the video, every rotation view, then :meth:`write_sequence` for
    the video and for the rotation views, then :meth:`write_points`. ``phantom.json`` and ``truth/`` are the same in
    every layout and not written by it.
    """

    #: Default width and height, pixels.
    default_size: ClassVar[tuple[int, int]] = (338, 270)
    #: Whether the layout supports rotation views; otherwise none are rendered.
    has_rotation: ClassVar[bool] = False
    #: Whether the layout has initial points, in place of depth.
    has_points: ClassVar[bool] = False

    def lens(self, width: int, height: int) -> tuple[Lens, Bool[np.ndarray, "H W"]]:
        """The lens of frames of this size, and the mask of lit pixels [H, W].

        Default: C3VD's undistorted camera, scaled by width, its principal point at the same distance from the middle;
        all pixels are lit.
        """
        return _scaled(_C3VD_PINHOLE, width, height), np.ones((height, width), bool)

    def lens_of(self, endoscope: FisheyeLens, width: int, height: int) -> Lens:
        """The lens of frames of this size that a real endoscope films, given its lens.

        Default: the nominal pinhole of that lens, without its distortion, scaled as in :meth:`lens`.
        """
        return _scaled(endoscope.pinhole, width, height)

    def is_test(self, index: int) -> bool:
        """Return whether a frame of the video is held out by the layout's split; default: 0, 8, 16, ..."""
        return index % TEST_EVERY == 0

    @abstractmethod
    def write_frame(self, folder: Path, frame: PhantomFrame) -> None:
        """Write one frame into the folder of the phantom."""

    @abstractmethod
    def write_sequence(self, folder: Path, part: Part, poses: Float[np.ndarray, "N 4 4"], lens: Lens) -> None:
        """Write the poses (camera-to-world, OpenCV axes, mm) of a part and, if in the layout, its lens, the camera."""

    def write_points(self, folder: Path, points: WallPoints, poses: Float[np.ndarray, "N 4 4"], lens: Lens) -> None:
        """Write initial points; called if :attr:`has_points`. ``poses`` are those of the video."""
        raise NotImplementedError(f"{type(self).__name__} does not support points")

    def seen_mask(self, folder: Path, part: Part, index: int) -> Path:
        """Path of the seen mask of a test frame."""
        return folder / ("truth" if part == "video" else part) / "seen" / f"{index:04d}_seen.png"


def _scaled(k: Intrinsics, width: int, height: int) -> PinholeLens:
    """A pinhole scaled by width, its principal point at the same distance from the middle."""
    scale = width / k.width
    cx = 0.5 * width + (k.cx - 0.5 * k.width) * scale
    cy = 0.5 * height + (k.cy - 0.5 * k.height) * scale
    return PinholeLens(k.fx * scale, k.fy * scale, cx, cy, width, height)


def part_folder(folder: Path, part: Part) -> Path:
    """Folder of a part, for layouts with rotation views in ``rotation/``."""
    return folder if part == "video" else folder / part


#: The largest number of 16 bits.
_LAST = 65_535
#: TUM's depth steps per mm: 0.002 mm each, up to 131 mm; farther is unknown, as for its sensor.
DEPTH_SCALE = 500.0
#: Seconds: TUM's clock and frame rate.
_START, _RATE = 1_305_031_102.0, 30.0
#: nerfstudio's millimetres per depth step: up to 655 mm.
_DEPTH_UNIT = 0.01
#: A mild barrel distortion, so that missing undistortion is noticed.
_DISTORTION: dict[str, Any] = {"k1": -0.2, "k2": 0.05, "p1": 0.001, "p2": -0.002}
#: COLMAP's points are observed in one of this many images that show them, like detected features.
_SEEN_IN_ONE_OF = 3


class C3VDLayout(Layout):
    """Undistorted frames in ColIAGS's layout: images/, depths/, camera_pose.txt, camera.json."""

    has_rotation = True

    def write_frame(self, folder: Path, frame: PhantomFrame) -> None:
        """Write the image, and depth in 16-bit steps up to 100 mm."""
        folder = part_folder(folder, frame.part)
        write_image(folder / "images" / f"{frame.index:04d}_color.png", frame.color)
        write_image(folder / "depths" / f"{frame.index:04d}_depth.png", depth_steps(frame.z_depth))

    def write_sequence(self, folder: Path, part: Part, poses: Float[np.ndarray, "N 4 4"], lens: Lens) -> None:
        """Write ``camera_pose.txt`` and ``camera.json``."""
        folder = part_folder(folder, part)
        write_poses(folder / "camera_pose.txt", poses)
        write_camera_json(folder / "camera.json", lens.pinhole, h=lens.height, w=lens.width)


def write_poses(path: Path, camera_to_world: Float[np.ndarray, "N 4 4"]) -> None:
    """Write C3VD's pose file with the release's nine digits; OpenCV axes, mm."""
    atomic_write(path, matrix_lines(camera_to_world, digits=9))


def depth_steps(
    z_depth: Float[np.ndarray, "H W"], per_mm: float = _LAST / 100.0, beyond: int = _LAST
) -> UInt16[np.ndarray, "H W"]:
    """z-depth, mm, in 16-bit steps, by default C3VD's: 0 where unknown, ``beyond`` where it is out of their range."""
    is_known = np.isfinite(z_depth) & (z_depth > 0.0)
    steps = np.maximum(np.rint(np.where(is_known, z_depth, 0.0) * per_mm), 1)
    return np.where(is_known, np.where(steps > _LAST, beyond, steps), 0).astype(np.uint16)


class SeenPoints(NamedTuple):
    """Observations of a model's points, by index from 0, in one image; pixel centres at integers + 0.5."""

    pixels: Float[np.ndarray, "K 2"]
    points: Int[np.ndarray, "K"]


def add_points(
    model: pycolmap.Reconstruction,
    seen: Sequence[SeenPoints],
    positions: Float[np.ndarray, "N 3"],
    colors: UInt8[np.ndarray, "N 3"],
) -> None:
    """Add points, in scene units, to a model of posed images; point k gets COLMAP's ID k + 1.

    ``seen`` are the observations of each image; image i has ID i + 1.
    """
    import pycolmap

    tracks = [pycolmap.Track() for _ in range(len(positions))]
    for number, here in enumerate(seen, start=1):
        model.images[number].points2D = pycolmap.Point2DList([pycolmap.Point2D(pixel) for pixel in here.pixels])
        for index, point in enumerate(here.points):
            tracks[point].add_element(number, index)
    for position, track, color in zip(positions, tracks, colors, strict=True):
        model.add_point3D(position, track, color)
    model.update_point_3d_errors()


class ColmapLayout(Layout):
    """images/, unit.txt and a binary model of one PINHOLE camera in sparse/0, its points with their images."""

    has_points = True

    def write_frame(self, folder: Path, frame: PhantomFrame) -> None:
        """Write the image; depth is not part of this layout."""
        write_image(folder / "images" / f"{frame.index:04d}.png", frame.color)

    def write_sequence(self, folder: Path, part: Part, poses: Float[np.ndarray, "N 4 4"], lens: Lens) -> None:
        """Write nothing: poses are part of the model."""

    def write_points(self, folder: Path, points: WallPoints, poses: Float[np.ndarray, "N 4 4"], lens: Lens) -> None:
        """Write the model; points seen in fewer than two images are left out, as COLMAP leaves them out."""
        names = [f"{index:04d}.png" for index in range(len(poses))]
        model = posed_model(colmap_poses(poses), names, [lens.pinhole], [0] * len(poses))
        numbers = np.arange(len(points.positions))
        seen = [points.seen_in(index) & ((numbers + index) % _SEEN_IN_ONE_OF == 0) for index in range(len(poses))]
        chosen = np.flatnonzero(np.sum(seen, axis=0) >= 2)
        observations = []
        for index, matrix in enumerate(inverse(poses)):
            indices = np.flatnonzero(seen[index][chosen])
            local = points.positions[chosen[indices]] @ matrix[:3, :3].T + matrix[:3, 3]
            observations.append(SeenPoints(lens.project(local), indices))
        add_points(model, observations, points.positions[chosen], points.colors[chosen])
        write_reconstruction(folder / "sparse/0", model)
        write_unit(folder, "mm")


class NerfstudioLayout(Layout):
    """images/, depth/, unit.txt and a transforms.json with a camera that distorts, OPENCV or OPENCV_FISHEYE."""

    def lens(self, width: int, height: int) -> tuple[Lens, Bool[np.ndarray, "H W"]]:
        """The default camera with OpenCV's lens distortion."""
        plain, lit = super().lens(width, height)
        return OpenCVLens(**vars(plain.pinhole), **_DISTORTION), lit

    def lens_of(self, endoscope: FisheyeLens, width: int, height: int) -> Lens:
        """The lens with its distortion; pixels from 90 degrees on stay black."""
        return replace(endoscope, **vars(super().lens_of(endoscope, width, height).pinhole))

    def write_frame(self, folder: Path, frame: PhantomFrame) -> None:
        """Write the image, and depth in steps of 0.01 mm."""
        name = f"frame_{frame.index + 1:05d}.png"
        write_image(folder / "images" / name, frame.color)
        steps = np.rint(frame.z_depth / _DEPTH_UNIT).clip(0, _LAST)
        write_image(folder / "depth" / name, steps.astype(np.uint16))

    def write_sequence(self, folder: Path, part: Part, poses: Float[np.ndarray, "N 4 4"], lens: Lens) -> None:
        """Write ``transforms.json`` and ``unit.txt``."""
        names = [f"frame_{index + 1:05d}.png" for index in range(len(poses))]
        frames = [
            {
                "file_path": f"images/{name}",
                "depth_file_path": f"depth/{name}",
                "transform_matrix": (pose @ FLIP_Y_AND_Z).tolist(),
            }
            for name, pose in zip(names, poses, strict=True)
        ]
        k, model, terms = lens.pinhole, "OPENCV", _DISTORTION
        if isinstance(lens, FisheyeLens):
            model, terms = "OPENCV_FISHEYE", {"k1": lens.k1, "k2": lens.k2, "k3": lens.k3, "k4": lens.k4}
        camera = {"fl_x": k.fx, "fl_y": k.fy, "cx": k.cx, "cy": k.cy, "w": lens.width, "h": lens.height, **terms}
        content = {"camera_model": model, **camera, "depth_unit_scale_factor": _DEPTH_UNIT, "frames": frames}
        write_json(folder / "transforms.json", content)
        write_unit(folder, "mm")


class RGBDLayout(Layout):
    """Images and depth named by timestamps, groundtruth.txt, camera.json, and TUM's file lists."""

    def write_frame(self, folder: Path, frame: PhantomFrame) -> None:
        """Write the image, and depth in TUM's steps."""
        name = f"{_time(frame.index)}.png"
        write_image(folder / "rgb" / name, frame.color)
        write_image(folder / "depth" / name, depth_steps(frame.z_depth, DEPTH_SCALE, 0))

    def write_sequence(self, folder: Path, part: Part, poses: Float[np.ndarray, "N 4 4"], lens: Lens) -> None:
        """Write the trajectory, the camera, ``unit.txt`` and the lists of files."""
        times = [_time(index) for index in range(len(poses))]
        tum.write(folder / "groundtruth.txt", Trajectory(poses, timestamps=np.array(times, np.float64)))
        write_camera_json(folder / "camera.json", lens.pinhole, h=lens.height, w=lens.width, depth_scale=DEPTH_SCALE)
        write_unit(folder, "mm")
        for kind in ("rgb", "depth"):
            lines = ["# timestamp filename", *(f"{time} {kind}/{time}.png" for time in times)]
            atomic_write(folder / f"{kind}.txt", "\n".join(lines) + "\n")


def _time(index: int) -> str:
    return f"{_START + index / _RATE:.6f}"
