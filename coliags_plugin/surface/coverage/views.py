"""What a camera recorded: poses, masks, brightness and rays through the lens of the stored images, not undistorted."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from functools import cached_property

import cv2
import numpy as np
from jaxtyping import Bool, Float, Float32, Int, UInt8

from coliags_plugin.core.errors import InputError
from coliags_plugin.core.images import read_rgb
from coliags_plugin.core.scenes import Frame, Scene
from coliags_plugin.datamanagers.reading.images import read_mask
from coliags_plugin.datamanagers.stored_frames import StoredFrame
from coliags_plugin.geometry.lenses.models import Lens, PinholeLens


@dataclass(frozen=True)
class CoverageView:
    """One recorded frame."""

    name: str
    camera_to_world: Float[np.ndarray, "4 4"]  # pose, OpenCV axes, mm
    lens: Lens  # the lens it was taken through, at the size of the image
    mask: Bool[np.ndarray, "H W"] | None = None  # pixels with image content; None for all
    # Reads the image through that lens; None where there is none.
    read_image: Callable[[], UInt8[np.ndarray, "H W 3"]] | None = field(default=None, repr=False)

    @property
    def center(self) -> Float[np.ndarray, "3"]:
        """Optical centre, world, mm. [3]"""
        return np.asarray(self.camera_to_world[:3, 3], np.float64)


@dataclass(frozen=True)
class RayGrid:
    """Viewing rays on an even grid over the image of a lens, R of them where the image has content."""

    size: tuple[int, int]  # width and height of the grid
    cells: Int[np.ndarray, "R"]  # indices in the grid, row by row
    directions: Float32[np.ndarray, "R 3"]  # camera axes, z = 1
    pixel_angles: Float32[np.ndarray, "R"]  # solid angle of one pixel of the image along each ray, steradians

    @classmethod
    def of(cls, lens: Lens, mask: Bool[np.ndarray, "H W"] | None, most: int) -> RayGrid:
        """The grid of a lens and mask, with at most about ``most`` rays and no more than 2 x 2 in a pixel."""
        scale = min(2.0, (most / (lens.width * lens.height)) ** 0.5)
        # Whole rays per pixel where there is one or more, so that every pixel is sampled alike.
        scale = scale if scale < 1.0 else float(int(scale))
        width, height = max(1, round(lens.width * scale)), max(1, round(lens.height * scale))
        column, row = np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5)
        stretch = np.array([lens.width / width, lens.height / height])
        pixels = np.stack([column.ravel(), row.ravel()], axis=1) * stretch
        inside = np.ones(len(pixels), bool)
        if mask is not None:
            inside = mask[pixels[:, 1].astype(int), pixels[:, 0].astype(int)]
        directions = np.full((len(pixels), 3), np.nan)
        directions[inside] = lens.unproject(pixels[inside])
        cells = np.flatnonzero(np.isfinite(directions).all(axis=1))
        directions = directions[cells]
        angles = _pixel_angles(lens, pixels[cells], directions)
        return cls((width, height), cells, directions.astype(np.float32), angles.astype(np.float32))

    def world_rays(self, view: CoverageView) -> Float32[np.ndarray, "R 3"]:
        """The directions in the world of a view's pose. [R, 3]"""
        return np.einsum("nc,dc->nd", self.directions, view.camera_to_world[:3, :3].astype(np.float32))

    @cached_property
    def narrowest_cosine(self) -> float:
        """Cosine of the widest angle of a ray to the optical axis."""
        return float(1.0 / np.linalg.norm(self.directions, axis=1).max()) if len(self.cells) else 1.0

    @cached_property
    def _ray_of_cell(self) -> Int[np.ndarray, "G"]:
        rays = np.full(self.size[0] * self.size[1], -1)
        rays[self.cells] = np.arange(len(self.cells))
        return rays

    def nearest(self, lens: Lens, pixels: Float[np.ndarray, "N 2"]) -> Int[np.ndarray, "N"]:
        """The ray nearest to each pixel of the lens; -1 outside the image and its content. [N]"""
        width, height = self.size
        with np.errstate(invalid="ignore"):
            cell = pixels * (width / lens.width, height / lens.height)
            inside = np.all((cell >= 0.0) & (cell < (width, height)), axis=1)
        column, row = np.where(inside[:, None], cell, 0.0).astype(int).T
        return np.asarray(np.where(inside, self._ray_of_cell[row * width + column], -1))

    def brightness(self, image: UInt8[np.ndarray, "H W 3"]) -> Float32[np.ndarray, "R"]:
        """Grey value of the image, 0 to 1, along each ray. [R]"""
        grey = cv2.cvtColor(image, cv2.COLOR_RGB2GRAY)
        width, height = self.size
        smaller = width < grey.shape[1]
        grey = cv2.resize(grey, (width, height), interpolation=cv2.INTER_AREA if smaller else cv2.INTER_NEAREST)
        return np.asarray(grey.reshape(-1)[self.cells].astype(np.float32) / np.float32(255.0))


def _pixel_angles(
    lens: Lens, pixels: Float[np.ndarray, "R 2"], directions: Float[np.ndarray, "R 3"]
) -> Float[np.ndarray, "R"]:
    """Solid angles of pixels, from directions half a pixel aside; 0 where the lens ends there. [R]"""
    right, down = (lens.unproject(pixels + aside) - lens.unproject(pixels - aside) for aside in 0.5 * np.eye(2))
    area = np.abs(right[:, 0] * down[:, 1] - right[:, 1] * down[:, 0])
    angles = area / np.linalg.norm(directions, axis=1) ** 3
    return np.asarray(np.nan_to_num(angles))


def recorded_views(scene: Scene) -> list[CoverageView]:
    """Views of all frames of the video, held out or not, in its order; two frames or more."""
    if len(scene.video) < 2:
        raise InputError(f"scene '{scene.name}' has {len(scene.video)} frame", "two frames or more")
    return [_view(frame) for frame in scene.video]


def _view(frame: Frame) -> CoverageView:
    if not isinstance(frame, StoredFrame):
        camera = frame.camera
        mask = None if frame.mask is None else frame.mask.numpy()
        pose = camera.camera_to_world.double().numpy()
        return CoverageView(frame.name, pose, PinholeLens.of(camera.intrinsics), mask, frame.image.numpy)
    shot, rectification = frame.shot, frame.shot.rectification
    content = rectification.stored_content
    if shot.mask is not None:
        mask = rectification.checked(shot.mask, read_mask(shot.mask))
        content = mask if content is None else mask & content
    pose = np.asarray(shot.camera_to_world, np.float64)
    return CoverageView(
        shot.name,
        pose,
        rectification.lens,
        content,
        lambda: rectification.checked(shot.image, read_rgb(shot.image)),
    )
