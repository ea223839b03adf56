"""Scenes, frames and targets, which data managers produce for training and evaluation."""

from __future__ import annotations

import math
from collections.abc import Callable, Collection, Iterator, Sequence
from copy import copy
from dataclasses import dataclass, field, replace
from itertools import chain
from pathlib import Path
from typing import Any, Protocol

import torch
from jaxtyping import Bool, Float, Int, UInt8
from torch import Tensor

from coliags_plugin.core.cameras import Camera
from coliags_plugin.core.provenance import Provenance
from coliags_plugin.core.tensors import pixel_ids, sent


@dataclass(frozen=True)
class SparseDepth:
    """z-depth known at single points of an image, as from structure from motion.

    Attributes:
        pixels: (column, row), centres at integers + 0.5; inside the image. [K, 2]
        depth: z-depth, scene units. [K]
    """

    pixels: Float[Tensor, "K 2"]
    depth: Float[Tensor, "K"]

    def scaled(self, factor: float) -> SparseDepth:
        """Return the points in a world whose lengths are ``factor`` times as large."""
        return replace(self, depth=factor * self.depth)

    def to(self, device: torch.device | str) -> SparseDepth:
        """Return the points on another device."""
        return SparseDepth(sent(self.pixels, device), sent(self.depth, device))


@dataclass(frozen=True)
class View:
    """Identity of the rendered frame, for view modules.

    Attributes:
        name: Name of the frame.
        time: Index of the frame in the video, counted from 0.
        trained: Whether it is among the training frames.
    """

    name: str
    time: float
    trained: bool


class _ImageAndMask(Protocol):
    @property
    def image(self) -> UInt8[Tensor, "H W 3"]: ...
    @property
    def mask(self) -> Bool[Tensor, "H W"] | None: ...


class _MaskedImage:
    """Float colours and a complete mask of classes with an image and an optional mask."""

    @property
    def rgb(self: _ImageAndMask) -> Float[Tensor, "H W 3"]:
        """The image in [0, 1], float32. [H, W, 3]"""
        return self.image.to(torch.float32) / 255.0

    @property
    def valid(self: _ImageAndMask) -> Bool[Tensor, "H W"]:
        """The mask, all True where there is none. [H, W]"""
        image, mask = self.image, self.mask
        return torch.ones(image.shape[:2], dtype=torch.bool, device=image.device) if mask is None else mask


@dataclass(frozen=True)
class Target(_MaskedImage):
    """Ground truth of a training step: a frame, or P pixels of frames as P rows and one column.

    Attributes:
        name: Of the frame, or of the frames.
        image: RGB. [H, W, 3]
        mask: False where a pixel is to be ignored. None means every pixel counts. [H, W]
        depth: z-depth, mm; NaN where unknown. None where there is none. [H, W]
        sparse_depth: Depth at single points of a whole frame; None where there is none.
        index: Of a whole frame in the video.
        chosen: Identifiers of the pixels, if they are not those of a whole frame. [H, W]
        depth_confidence: How far ``depth`` can be trusted, see :class:`Frame`; None where it is true. [H, W]
    """

    name: str
    image: UInt8[Tensor, "H W 3"]
    mask: Bool[Tensor, "H W"] | None = None
    depth: Float[Tensor, "H W"] | None = None
    sparse_depth: SparseDepth | None = None
    index: int = 0
    chosen: Int[Tensor, "H W"] | None = None
    depth_confidence: Float[Tensor, "H W"] | None = None

    @property
    def ids(self) -> Int[Tensor, "H W"]:
        """A number for every pixel that no other of the training frames has. [H, W]"""
        if self.chosen is not None:
            return self.chosen
        height, width = self.image.shape[:2]
        return pixel_ids(self.index, torch.arange(height * width, device=self.image.device).view(height, width))


@dataclass(frozen=True)
class Frame(_MaskedImage):
    """One posed image. Tensors stay on the CPU until :meth:`to` moves them.

    Attributes:
        name: Unique within the scene; the file's stem where there is one.
        index: Of the frame in the video, counted from 0.
        image: RGB. [H, W, 3]
        camera: Camera that took it.
        depth: z-depth, mm; NaN where unknown. None where the dataset has none. [H, W]
        mask: False where a pixel is to be ignored. None means every pixel counts. [H, W]
        seen: For test views with ground-truth geometry: True where a training frame sees the same surface. [H, W]
        depth_at_least: Where the depth sensor clipped, the z-depth it clipped at, mm: the surface lies there or beyond
            and ``depth`` is NaN. NaN elsewhere; None where nothing is clipped. [H, W]
        sparse_depth: Depth at single points; None where the dataset has none.
        depth_confidence: Of estimated depth, the estimated probability in [0, 1] that its relative error is below 5 %;
            0 where it follows a prior only. None where ``depth`` is true: measured or rendered. [H, W]
    """

    name: str
    index: int
    image: UInt8[Tensor, "H W 3"]
    camera: Camera
    depth: Float[Tensor, "H W"] | None = None
    mask: Bool[Tensor, "H W"] | None = None
    seen: Bool[Tensor, "H W"] | None = None
    depth_at_least: Float[Tensor, "H W"] | None = None
    sparse_depth: SparseDepth | None = None
    depth_confidence: Float[Tensor, "H W"] | None = None

    @property
    def target(self) -> Target:
        """The whole frame as a target."""
        return Target(
            self.name,
            self.image,
            self.mask,
            self.depth,
            self.sparse_depth,
            self.index,
            depth_confidence=self.depth_confidence,
        )

    def target_at(self, pixels: Int[Tensor, "P 2"]) -> Target:
        """Some pixels, by columns and rows, as a target."""
        column, row = pixels.to(self.image.device).unbind(1)

        def taken(values: Tensor | None) -> Tensor | None:
            return None if values is None else values[row, column][:, None]

        image, mask, depth = self.image[row, column][:, None], taken(self.mask), taken(self.depth)
        chosen = pixel_ids(self.index, row * self.image.shape[1] + column)[:, None]
        return Target(self.name, image, mask, depth, chosen=chosen, depth_confidence=taken(self.depth_confidence))

    @property
    def true_depth(self) -> Float[Tensor, "H W"] | None:
        """The depth, if it was measured or rendered; None where there is none or it is an estimate. [H, W]"""
        return self.depth if self.depth_confidence is None else None

    def with_near_plane(self, near_plane: float) -> Frame:
        """Return the frame with another near plane of its camera, scene units; images are read as lazily as before."""
        frame = copy(self)
        object.__setattr__(frame, "camera", replace(self.camera, near_plane=near_plane))
        return frame

    def scaled(self, factor: float) -> Frame:
        """Return the frame in a world whose lengths are ``factor`` times as large; images are read lazily as before."""
        sparse, depths = self.sparse_depth, {"depth": self.depth, "depth_at_least": self.depth_at_least}
        scaled: dict[str, Any] = {name: None if depth is None else factor * depth for name, depth in depths.items()}
        scaled["sparse_depth"] = None if sparse is None else sparse.scaled(factor)
        return replace(self, camera=self.camera.scaled(factor), **scaled)

    def view(self, trained: bool) -> View:
        """This frame, for the modules of a model."""
        return View(self.name, float(self.index), trained)

    def to(self, device: torch.device | str) -> Frame:
        """Return the frame on another device."""
        names = ("image", "depth", "mask", "seen", "depth_at_least", "depth_confidence")
        moved: dict[str, Any] = {name: getattr(self, name) for name in names}
        moved = {name: values if values is None else sent(values, device) for name, values in moved.items()}
        sparse = None if self.sparse_depth is None else self.sparse_depth.to(device)
        return Frame(self.name, self.index, camera=self.camera.to(device), sparse_depth=sparse, **moved)


@dataclass(frozen=True)
class PointCloud:
    """Points on the surface, world frame.

    Attributes:
        positions: Scene units (mm for C3VD). [N, 3]
        colors: RGB, or None. [N, 3]
    """

    positions: Float[Tensor, "N 3"]
    colors: UInt8[Tensor, "N 3"] | None = None

    def __len__(self) -> int:
        return len(self.positions)


@dataclass(frozen=True, eq=False)
class Scene:
    """A dataset with its split and initial points; equal to itself alone.

    Attributes:
        name: Short name for folders and tables.
        train: Frames to train on, in video order.
        test_sets: Held-out frames by set name; ``"test"`` is the split's own, others (``"rotation"``) come with
            the data.
        points: Initial points.
        provenance: Origin of the data.
        folder: Where it was read from; None: made in memory.
    """

    name: str
    train: list[Frame]
    test_sets: dict[str, list[Frame]]
    points: PointCloud
    provenance: Provenance = field(default_factory=Provenance)
    folder: Path | None = None

    @property
    def video(self) -> list[Frame]:
        """Training frames and the split's own test frames, in video order."""
        return sorted([*self.train, *self.test_sets.get("test", ())], key=lambda frame: frame.index)

    @property
    def is_resized(self) -> bool:
        """Whether images are known to be used at another size than they are stored at."""
        return self.provenance.stored_size not in (None, self.provenance.size)

    @property
    def is_metric(self) -> bool:
        """Whether lengths are in mm; False where their unit is unknown."""
        return self.provenance.unit == "mm"

    @property
    def length_unit(self) -> str:
        """Unit of lengths, as printed: ``mm``, or ``units`` where it is unknown."""
        return "mm" if self.is_metric else "units"

    def __repr__(self) -> str:
        """Counts, not pixels."""
        sets = {"train": self.train, **self.test_sets}
        counts = ", ".join(f"{len(frames)} {name}" for name, frames in sets.items())
        return f"Scene {self.name}: frames {counts}; {len(self.points)} points"

    def with_near_plane(self, near_plane: float) -> Scene:
        """The scene with this near plane of all cameras, scene units; itself, where it has it."""
        frames = chain(self.train, *self.test_sets.values())
        if all(frame.camera.near_plane == near_plane for frame in frames):
            return self
        return self._with_frames(lambda frame: frame.with_near_plane(near_plane))

    def scaled(self, factor: float) -> Scene:
        """The scene in a world whose lengths are ``factor`` times as large."""
        if factor == 1.0:
            return self
        points = replace(self.points, positions=factor * self.points.positions)
        return replace(self._with_frames(lambda frame: frame.scaled(factor)), points=points)

    def _with_frames(self, changed: Callable[[Frame], Frame]) -> Scene:
        tests = {name: [changed(frame) for frame in part] for name, part in self.test_sets.items()}
        return replace(self, train=[changed(frame) for frame in self.train], test_sets=tests)

    def without(self, names: Collection[str]) -> Scene:
        """The scene without the frames of these names."""
        train = [frame for frame in self.train if frame.name not in names]
        tests = {
            part: [frame for frame in frames if frame.name not in names] for part, frames in self.test_sets.items()
        }
        return replace(self, train=train, test_sets=tests)

    @property
    def extent(self) -> float:
        """1.1 times the largest distance of a training camera from their mean, scene units (docs/methods.md 2.1)."""
        centers = torch.stack([frame.camera.center for frame in self.train])
        return 1.1 * float((centers - centers.mean(0)).norm(dim=1).max())

    @property
    def pixel_footprint(self) -> float:
        """Median size of a training pixel on the surface, scene units: depth over focal length of the points in view.

        Occlusion is not tested. Falls back to all points in front of the cameras where none is in view; NaN where none
        is in front.
        """
        sizes, fallback = [], []
        for camera, depth, inside in self._projected_points():
            size = depth / (camera.fx * camera.fy) ** 0.5
            sizes.append(size[inside])
            fallback.append(size[depth > 0])
        found, others = torch.cat(sizes), torch.cat(fallback)
        return float((found if len(found) else others).median()) if len(others) else math.nan

    def depths_in_view(self) -> Float[Tensor, "K"]:
        """z-depths of the points inside the images of up to 16 training frames, scene units, occluded or not."""
        return torch.cat([depth[inside] for _, depth, inside in self._projected_points()])

    def _projected_points(self) -> Iterator[tuple[Camera, Tensor, Tensor]]:
        """Camera, z-depth of every point and whether it is inside the image, of up to 16 training frames."""
        points = self.points.positions.double()
        for frame in self.train[:: max(1, len(self.train) // 16)]:
            camera = frame.camera.to(points.device, points.dtype)
            yield camera, *camera.sees(points)


def concatenate_targets(parts: Sequence[Target]) -> Target:
    """Pixel batches of several frames, of P_i rows and one column each, as one.

    A missing mask is all True; beside others, missing depth is all NaN and missing confidence all 1.
    """
    if len(parts) == 1:
        return parts[0]
    masks = None if all(part.mask is None for part in parts) else torch.cat([part.valid for part in parts])
    depths = _joined(parts, [part.depth for part in parts], torch.nan)
    confidences = _joined(parts, [part.depth_confidence for part in parts], 1.0)
    images, chosen = torch.cat([part.image for part in parts]), torch.cat([part.ids for part in parts])
    name = ", ".join(part.name for part in parts)
    return Target(name, images, masks, depths, chosen=chosen, depth_confidence=confidences)


def _joined(parts: Sequence[Target], maps: Sequence[Tensor | None], instead: float) -> Tensor | None:
    """One map of several targets, concatenated; a constant for targets without it, None where no target has it."""
    if all(own is None for own in maps):
        return None
    return torch.cat(
        [
            torch.full(part.image.shape[:2], instead, device=part.image.device) if own is None else own
            for part, own in zip(parts, maps, strict=True)
        ]
    )
