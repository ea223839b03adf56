"""Frames of one C3VD sequence, brought to the working size and to a pinhole camera."""

from __future__ import annotations

import os
from collections.abc import Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Bool, Float, Shaped, UInt8

from coliags_plugin.cameras import Camera
from coliags_plugin.datamanagers.c3vd_layouts import Layout, read_intrinsics
from coliags_plugin.datamanagers.c3vd_poses import Poses, read_poses
from coliags_plugin.datamanagers.images import (
    clipped_at,
    millimetres,
    read_depth_steps,
    read_mask,
    read_rgb,
    resize_nearest,
    resize_rgb,
)
from coliags_plugin.errors import InputError
from coliags_plugin.lenses import Lens, Pinhole, octagon_mask
from coliags_plugin.scenes import Frame
from coliags_plugin.undistortion import Undistortion

#: How far a raw frame's aspect ratio may be from the lens's: rounding to whole pixels, but no cropping.
ASPECT_TOLERANCE = 0.02

#: The paper's working size, a quarter of C3VD's raw frame.
PAPER_SIZE = (338, 270)


def default_size(width: int, height: int) -> tuple[int, int]:
    """The largest size that fits the paper's 338 x 270, keeps the aspect ratio and enlarges nothing, pixels."""
    scale = min(1.0, PAPER_SIZE[0] / width, PAPER_SIZE[1] / height)
    if scale == 1.0:
        return width, height
    # Halves are rounded up: the paper's 338 is a quarter of 1350.
    fitted = int(width * scale + 0.5), int(height * scale + 0.5)
    return max(1, fitted[0]), max(1, fitted[1])


@dataclass(frozen=True)
class View:
    """How stored pictures become working pictures.

    Attributes:
        source_width, source_height: Size of the stored pictures, pixels.
        width, height: Working size, pixels.
        pinhole: Intrinsics at the working size, pixels, centres at integers.
        undistortion: For raw pictures; None where they are pinhole pictures already.
    """

    source_width: int
    source_height: int
    width: int
    height: int
    pinhole: Pinhole
    undistortion: Undistortion | None = None

    @classmethod
    def of_raw(cls, image: Path, lens: Lens, size: tuple[int, int] | None, focal_scale: float, mask: bool) -> View:
        """The view of distorted pictures like ``image``, undistorted to the lens's nominal pinhole.

        Args:
            image: One of the pictures.
            lens: Theirs.
            size: Working width and height, pixels; None: :func:`default_size`.
            focal_scale: Factor on the nominal focal length.
            mask: Leave out what lies outside the octagon.

        Raises:
            InputError: The picture is a crop, so that the lens's calibration does not apply to it.
        """
        source_height, source_width = read_rgb(image).shape[:2]
        if abs((source_width / source_height) / (lens.width / lens.height) - 1.0) > ASPECT_TOLERANCE:
            raise InputError(
                f"{image} is {source_width} x {source_height}",
                f"the whole raw frame that the lens is calibrated for, {lens.width} x {lens.height} or scaled from it",
                "Undistort cropped pictures yourself and give them in the undistorted layout",
            )
        source = lens.scaled(source_width, source_height)
        width, height = size or default_size(source_width, source_height)
        nominal = lens.scaled(width, height).pinhole
        pinhole = nominal._replace(fx=nominal.fx * focal_scale, fy=nominal.fy * focal_scale)
        octagon = octagon_mask(source_width, source_height) if mask else None
        return cls(
            source_width, source_height, width, height, pinhole, Undistortion(source, pinhole, width, height, octagon)
        )

    @classmethod
    def of_undistorted(cls, camera_json: Path, size: tuple[int, int] | None) -> View:
        """The view of pinhole pictures whose intrinsics stand in ``camera.json``; ``size`` as for :meth:`of_raw`."""
        pinhole, source_width, source_height = read_intrinsics(camera_json)
        width, height = size or default_size(source_width, source_height)
        scaled = pinhole.scaled(width / source_width, height / source_height)
        return cls(source_width, source_height, width, height, scaled)

    def camera(self, camera_to_world: Float[np.ndarray, "4 4"]) -> Camera:
        """The working camera, whose pixel centres are at integers + 0.5."""
        fx, fy, cx, cy = self.pinhole
        matrix = torch.from_numpy(camera_to_world.astype(np.float32))
        return Camera(fx, fy, cx + 0.5, cy + 0.5, self.width, self.height, matrix)

    def image(self, rgb: UInt8[np.ndarray, "H W 3"]) -> UInt8[np.ndarray, "h w 3"]:
        """A colour picture at the working size."""
        if self.undistortion is None:
            return resize_rgb(rgb, self.width, self.height)
        return self.undistortion.image(rgb)

    def nearest(self, values: Shaped[np.ndarray, "H W"]) -> Shaped[np.ndarray, "h w"]:
        """Values at the working size, unmixed; 0 where there is no source."""
        if self.undistortion is None:
            return resize_nearest(values, self.width, self.height)
        return self.undistortion.nearest(values, 0)

    @property
    def valid(self) -> Bool[np.ndarray, "h w"] | None:
        """Working pixels that show something; None where all do."""
        if self.undistortion is None or self.undistortion.valid.all():
            return None
        return self.undistortion.valid


class SequenceReader:
    """Reads the frames of one sequence.

    Args:
        layout: Its files.
        lens: Of raw pictures.
        size: Working width and height, pixels; None: :func:`default_size`.
        focal_scale: Factor on the nominal focal length of undistorted raw pictures.
        mask: Leave out what lies outside raw pictures' octagon.

    Raises:
        InputError: Poses or intrinsics cannot be used, or there are not as many poses as pictures.
    """

    def __init__(
        self,
        layout: Layout,
        lens: Lens,
        *,
        size: tuple[int, int] | None = None,
        focal_scale: float = 1.0,
        mask: bool = True,
    ) -> None:
        self.layout = layout
        self.poses: Poses = read_poses(layout.poses)
        if len(self.poses.camera_to_world) != len(layout.images):
            raise InputError(
                f"{layout.poses} has {len(self.poses.camera_to_world)} poses for {len(layout.images)} pictures",
                "a line for every picture, in order",
                "Restore the missing ones, or remove the surplus at the end",
            )
        if layout.camera is None:
            self.view = View.of_raw(layout.images[0], lens, size, focal_scale, mask)
        else:
            self.view = View.of_undistorted(layout.camera, size)

    def read(self, index: int, prefix: str = "", seen: Path | None = None) -> Frame:
        """One frame.

        Args:
            index: Which.
            prefix: Put before its file's stem to make its name.
            seen: The picture of :attr:`Frame.seen`, in the geometry of the stored pictures.

        Raises:
            InputError: A file is damaged, of the wrong kind or of the wrong size.
        """
        path = self.layout.images[index]
        image = self._of_right_size(path, read_rgb(path))
        valid = self.view.valid
        depth = bound = None
        if self.layout.depths is not None:
            steps = self._of_right_size(self.layout.depths[index], read_depth_steps(self.layout.depths[index]))
            steps = self.view.nearest(steps)
            if valid is not None:
                steps = np.where(valid, steps, 0).astype(steps.dtype)
            depth, bound = millimetres(steps), clipped_at(steps)
        seen_mask = None if seen is None else self.view.nearest(self._of_right_size(seen, read_mask(seen)))
        return Frame(
            name=prefix + path.stem,
            index=index,
            image=torch.from_numpy(self.view.image(image)),
            camera=self.view.camera(self.poses.camera_to_world[index]),
            depth=None if depth is None else torch.from_numpy(depth),
            depth_at_least=None if bound is None else torch.from_numpy(bound),
            mask=None if valid is None else torch.from_numpy(valid),
            seen=None if seen_mask is None else torch.from_numpy(seen_mask),
        )

    def read_all(self, indices: list[int], prefix: str = "", seen: Mapping[int, Path] | None = None) -> list[Frame]:
        """Several frames, in the order asked for, read side by side.

        Raises:
            InputError: As :meth:`read`, for the first bad frame.
        """
        seen = seen or {}
        workers = min(8, os.cpu_count() or 1)
        with ThreadPoolExecutor(workers) as pool:
            pending = [pool.submit(self.read, index, prefix, seen.get(index)) for index in indices]
            try:
                return [future.result() for future in pending]
            except BaseException:
                pool.shutdown(cancel_futures=True)
                raise

    def _of_right_size(self, path: Path, picture: np.ndarray) -> np.ndarray:
        height, width = picture.shape[:2]
        if (width, height) != (self.view.source_width, self.view.source_height):
            says = self.layout.camera or self.layout.images[0]
            raise InputError(
                f"{path} is {width} x {height}, but {says} says {self.view.source_width} x {self.view.source_height}",
                "pictures of one size",
                "Write that picture again, or mend w and h",
            )
        return picture
