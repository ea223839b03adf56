"""Scenes, frames and targets, which data managers produce for training and evaluation."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import chain
from pathlib import Path
from typing import cast

import torch
from jaxtyping import Bool, Float, Int, UInt8
from torch import Tensor
from typing_extensions import override

from coliags_plugin.core import bounds
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


@dataclass(frozen=True)
class PixelMap:
    """Schema of one kind of per-pixel values of frames."""

    dtype: torch.dtype
    high: float = 1.0  # largest value; the least is 0, which is no depth
    is_smooth: bool = False  # resized by area averaging or interpolation; others by nearest neighbour
    is_length: bool = False  # scales with the world
    #: Value in a batch of pixels for a frame without this map; None: the map is not part of training targets.
    fill: float | None = None


#: All per-pixel maps of frames by name; :class:`PixelMaps` has a typed property for each.
PIXEL_MAPS: Mapping[str, PixelMap] = {
    "image": PixelMap(torch.uint8, high=255.0, is_smooth=True, fill=0.0),
    "mask": PixelMap(torch.bool, fill=1.0),
    "depth": PixelMap(torch.float32, high=bounds.LENGTH, is_length=True, fill=math.nan),
    "depth_at_least": PixelMap(torch.float32, high=bounds.LENGTH, is_length=True),
    "depth_confidence": PixelMap(torch.float32, fill=1.0),
    "seen": PixelMap(torch.bool),
}


class PixelSource(ABC):
    """Source of the per-pixel maps of a frame: memory or files."""

    @abstractmethod
    def read(self, name: str) -> Tensor | None:
        """The map of a name in :data:`PIXEL_MAPS`; None where there is none. [H, W, ...]"""

    def read_all(self) -> dict[str, Tensor]:
        """All maps there are, by name; files are read once."""
        return {name: values for name in PIXEL_MAPS if (values := self.read(name)) is not None}

    @abstractmethod
    def scaled(self, factor: float) -> PixelSource:
        """The source in a world whose lengths are ``factor`` times as large; it reads nothing."""


@dataclass(frozen=True, eq=False)
class PixelTensors(PixelSource):
    """Per-pixel maps in memory, by name."""

    maps: Mapping[str, Tensor]

    @override
    def read(self, name: str) -> Tensor | None:
        return self.maps.get(name)

    @override
    def scaled(self, factor: float) -> PixelTensors:
        lengths = {name: factor * values for name, values in self.maps.items() if PIXEL_MAPS[name].is_length}
        return PixelTensors({**self.maps, **lengths})


class PixelMaps:
    """Typed access to the maps of a source; the image is always there, others may be None.

    Files are read at each access unless their source keeps them.
    """

    source: PixelSource

    @property
    def image(self) -> UInt8[Tensor, "H W 3"]:
        """RGB. [H, W, 3]"""
        return cast(Tensor, self.source.read("image"))

    @property
    def mask(self) -> Bool[Tensor, "H W"] | None:
        """False where a pixel is to be ignored; None means every pixel counts. [H, W]"""
        return self.source.read("mask")

    @property
    def depth(self) -> Float[Tensor, "H W"] | None:
        """z-depth, mm; NaN where unknown. [H, W]"""
        return self.source.read("depth")

    @property
    def depth_at_least(self) -> Float[Tensor, "H W"] | None:
        """Lower bound of the depth of clipped pixels, mm, where ``depth`` is NaN.

        NaN elsewhere. [H, W]
        """
        return self.source.read("depth_at_least")

    @property
    def depth_confidence(self) -> Float[Tensor, "H W"] | None:
        """Probability in [0, 1] that the relative error of estimated depth is below 5 %; 0 where it is a mere prior.

        None where ``depth`` is true: measured or rendered. [H, W]
        """
        return self.source.read("depth_confidence")

    @property
    def seen(self) -> Bool[Tensor, "H W"] | None:
        """True where a training frame sees the same surface; of test views with ground-truth geometry. [H, W]"""
        return self.source.read("seen")

    @property
    def rgb(self) -> Float[Tensor, "H W 3"]:
        """The image in [0, 1], float32. [H, W, 3]"""
        return self.image.to(torch.float32) / 255.0

    @property
    def valid(self) -> Bool[Tensor, "H W"]:
        """The mask, all True where there is none. [H, W]"""
        if (mask := self.mask) is not None:
            return mask
        return torch.ones(self.image.shape[:2], dtype=torch.bool, device=self.image.device)


@dataclass(frozen=True)
class Target(PixelMaps):
    """Ground truth of a training step: a frame, or P pixels of frames as P rows and one column.

    Attributes:
        name: Name of the frame, or of the frames.
        source: Per-pixel maps that have a :attr:`PixelMap.fill`.
        sparse_depth: Depth at single points of a whole frame; None where there is none.
        index: Index of a whole frame in the video.
        chosen: Identifiers of the pixels, if they are not those of a whole frame. [H, W]
    """

    name: str
    source: PixelTensors
    sparse_depth: SparseDepth | None = None
    index: int = 0
    chosen: Int[Tensor, "H W"] | None = None

    @property
    def ids(self) -> Int[Tensor, "H W"]:
        """A number for every pixel that no other of the training frames has. [H, W]"""
        if self.chosen is not None:
            return self.chosen
        height, width = self.image.shape[:2]
        return pixel_ids(self.index, torch.arange(height * width, device=self.image.device).view(height, width))


@dataclass(frozen=True)
class Frame(PixelMaps):
    """One posed image. Its maps stay on the CPU until :meth:`to` moves them.

    Attributes:
        name: Unique within the scene; the file's stem where there is one.
        index: Index in the video, counted from 0.
        source: Source of the per-pixel maps.
        camera: Camera that took it.
        sparse_depth: Depth at single points; None where the dataset has none.
    """

    name: str
    index: int
    source: PixelSource = field(repr=False)
    camera: Camera
    sparse_depth: SparseDepth | None = None

    @classmethod
    def of(
        cls,
        name: str,
        index: int,
        image: UInt8[Tensor, "H W 3"],
        camera: Camera,
        depth: Float[Tensor, "H W"] | None = None,
        mask: Bool[Tensor, "H W"] | None = None,
        sparse_depth: SparseDepth | None = None,
        **maps: Tensor | None,
    ) -> Frame:
        """A frame in memory; ``maps`` are further per-pixel maps, by the names in :data:`PIXEL_MAPS`."""
        frame = cls(name, index, PixelTensors({"image": image}), camera, sparse_depth)
        return frame.with_maps(depth=depth, mask=mask, **maps)

    def with_maps(self, **maps: Tensor | None) -> Frame:
        """The frame with other per-pixel maps of these names, all of them in memory; None removes one."""
        if unknown := maps.keys() - PIXEL_MAPS.keys():
            raise TypeError(f"no per-pixel map is called {', '.join(sorted(unknown))}")
        changed = {**self.source.read_all(), **maps}
        present = {name: values for name, values in changed.items() if values is not None}
        return replace(self, source=PixelTensors(present))

    @property
    @override
    def valid(self) -> Bool[Tensor, "H W"]:
        mask, camera = self.mask, self.camera  # without reading the image
        size, device = (camera.height, camera.width), camera.camera_to_world.device
        return torch.ones(size, dtype=torch.bool, device=device) if mask is None else mask

    @property
    def target(self) -> Target:
        """The whole frame as a target."""
        return Target(self.name, self._target_maps(lambda values: values), self.sparse_depth, self.index)

    def target_at(self, pixels: Int[Tensor, "P 2"]) -> Target:
        """Some pixels, by columns and rows, as a target."""
        column, row = pixels.to(self.camera.camera_to_world.device).unbind(1)
        maps = self._target_maps(lambda values: values[row, column][:, None])
        return Target(self.name, maps, chosen=pixel_ids(self.index, row * self.camera.width + column)[:, None])

    def _target_maps(self, select: Callable[[Tensor], Tensor]) -> PixelTensors:
        maps = {name: self.source.read(name) for name, schema in PIXEL_MAPS.items() if schema.fill is not None}
        return PixelTensors({name: select(values) for name, values in maps.items() if values is not None})

    @property
    def true_depth(self) -> Float[Tensor, "H W"] | None:
        """The depth, if it was measured or rendered; None where there is none or it is an estimate. [H, W]"""
        return self.depth if self.depth_confidence is None else None

    def with_near_plane(self, near_plane: float) -> Frame:
        """The frame with another near plane of its camera, scene units."""
        return replace(self, camera=replace(self.camera, near_plane=near_plane))

    def scaled(self, factor: float) -> Frame:
        """The frame in a world whose lengths are ``factor`` times as large."""
        sparse = None if self.sparse_depth is None else self.sparse_depth.scaled(factor)
        camera, source = self.camera.scaled(factor), self.source.scaled(factor)
        return replace(self, camera=camera, source=source, sparse_depth=sparse)

    def view(self, trained: bool) -> View:
        """This frame, for the modules of a model."""
        return View(self.name, float(self.index), trained)

    def to(self, device: torch.device | str) -> Frame:
        """The frame in the memory of a device."""
        maps = PixelTensors({name: sent(values, device) for name, values in self.source.read_all().items()})
        sparse = None if self.sparse_depth is None else self.sparse_depth.to(device)
        return replace(self, source=maps, camera=self.camera.to(device), sparse_depth=sparse)


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


#: What to do about a scene with poses and without dense depth, whether it has points or not.
TO_GET_DEPTH = (
    "`coliags depth SCENE --output SCENE-depth` estimates depth, and `coliags train coliags-plus --data SCENE-depth` "
    "trains on it"
)


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
    def has_estimated_depth(self) -> bool:
        """True if depth of the video is an estimate, with a confidence."""
        return any(frame.depth_confidence is not None for frame in self.video)

    @property
    def is_resized(self) -> bool:
        """True if images are known to be used at another size than they are stored at."""
        return self.provenance.stored_size not in (None, self.provenance.size)

    @property
    def is_metric(self) -> bool:
        """True if lengths are in mm; False where their unit is unknown."""
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
        in_view, others = torch.cat(sizes), torch.cat(fallback)
        return float((in_view if len(in_view) else others).median()) if len(others) else math.nan

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
    """Pixel batches of several frames, of P_i rows and one column each, as one; missing maps are filled."""
    if len(parts) == 1:
        return parts[0]
    maps = {
        name: torch.cat([_filled(part, name) for part in parts])
        for name in PIXEL_MAPS
        if any(name in part.source.maps for part in parts)
    }
    chosen, name = torch.cat([part.ids for part in parts]), ", ".join(part.name for part in parts)
    return Target(name, PixelTensors(maps), chosen=chosen)


def _filled(part: Target, name: str) -> Tensor:
    """A map of a target, or its :attr:`PixelMap.fill` everywhere."""
    if name in part.source.maps:
        return part.source.maps[name]
    schema, image = PIXEL_MAPS[name], part.image
    return torch.full(image.shape[:2], cast(float, schema.fill), dtype=schema.dtype, device=image.device)
