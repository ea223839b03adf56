"""What a data manager hands to training and evaluation."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import torch
from jaxtyping import Bool, Float, UInt8
from torch import Tensor

from coliags_plugin.core.cameras import Camera


@dataclass(frozen=True)
class SparseDepth:
    """z-depth known at single points of a picture, as structure from motion finds it.

    Attributes:
        pixels: (column, row), centres at integers + 0.5; inside the picture. [K, 2]
        depth: z-depth, scene units. [K]
    """

    pixels: Float[Tensor, "K 2"]
    depth: Float[Tensor, "K"]

    def to(self, device: torch.device | str) -> SparseDepth:
        """The same points on another device."""
        return SparseDepth(self.pixels.to(device), self.depth.to(device))


@dataclass(frozen=True)
class Frame:
    """One posed picture. Tensors stay on the CPU until :meth:`to` moves them.

    Attributes:
        name: Unique within the scene; the file's stem where there is one.
        index: Place in the video, counted from 0.
        image: RGB. [H, W, 3]
        camera: Where it was taken from.
        depth: z-depth, mm; NaN where unknown. None where the dataset has none. [H, W]
        mask: False where a pixel is to be ignored. None means every pixel counts. [H, W]
        seen: For test views with ground-truth geometry: True where a training frame sees the same surface. [H, W]
        depth_at_least: Where the depth sensor clipped, the z-depth it clipped at, mm: the surface lies there or beyond
            and ``depth`` is NaN. NaN elsewhere; None where nothing is clipped. [H, W]
        sparse_depth: Depth at single points; None where the dataset has none.
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

    @property
    def rgb(self) -> Float[Tensor, "H W 3"]:
        """The image in [0, 1], float32. [H, W, 3]"""
        return self.image.to(torch.float32) / 255.0

    @property
    def valid(self) -> Bool[Tensor, "H W"]:
        """The mask, all True where there is none. [H, W]"""
        if self.mask is not None:
            return self.mask
        return torch.ones(self.image.shape[:2], dtype=torch.bool, device=self.image.device)

    def to(self, device: torch.device | str) -> Frame:
        """The same frame on another device."""
        names = ("image", "camera", "depth", "mask", "seen", "depth_at_least", "sparse_depth")
        values = {name: getattr(self, name) for name in names}
        moved: dict[str, Any] = {name: value if value is None else value.to(device) for name, value in values.items()}
        return Frame(self.name, self.index, **moved)


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


@dataclass(frozen=True)
class Scene:
    """A dataset, read and split.

    Attributes:
        name: Short name for folders and tables.
        train: Frames to train on, in video order.
        test_sets: Held-out frames by set name; ``"test"`` is the split's own, others (``"rotation"``) come with
            the data.
        points: Initial points.
        provenance: Where all this came from: dataset, layout, calibration, pose convention, split, fingerprints.
    """

    name: str
    train: list[Frame]
    test_sets: dict[str, list[Frame]]
    points: PointCloud
    provenance: dict[str, Any] = field(default_factory=dict)

    @property
    def extent(self) -> float:
        """1.1 times the largest distance of a training camera from their mean, scene units (docs/methods.md 2.1)."""
        centers = torch.stack([frame.camera.center for frame in self.train])
        return 1.1 * float((centers - centers.mean(0)).norm(dim=1).max())

    @property
    def pixel_footprint(self) -> float:
        """Median size of a training pixel on the surface, scene units: depth over focal length of the points in view.

        Occlusion is not tested. Falls back to all points in front of the cameras where none is in view.
        """
        sizes, fallback = [], []
        points = self.points.positions.double()
        for frame in self.train[:: max(1, len(self.train) // 16)]:
            camera = frame.camera
            pixels, depth = camera.to(points.device, points.dtype).project(points)
            size = depth / (camera.fx * camera.fy) ** 0.5
            inside = ((pixels >= 0) & (pixels < pixels.new_tensor([camera.width, camera.height]))).all(dim=1)
            sizes.append(size[(depth > 0) & inside])
            fallback.append(size[depth > 0])
        found = torch.cat(sizes)
        return float((found if len(found) else torch.cat(fallback)).median())
