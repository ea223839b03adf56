"""Errors by the two factors of light attenuation: distance from the camera, and angle to its optical axis."""

from __future__ import annotations

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from coliags_plugin.contracts import Comparison
from coliags_plugin.core.cameras import Camera
from coliags_plugin.core.scenes import Frame
from coliags_plugin.results.record import ProfileRecord

#: Distance from the camera's centre along the pixel's ray, scene units (mm).
DISTANCE_EDGES = (0.0, 5.0, 10.0, 15.0, 20.0, 30.0, 40.0, 60.0, 80.0, 100.0, 150.0, 200.0, 300.0)
#: Angle of the pixel's ray to the optical axis, degrees.
ANGLE_EDGES = tuple(float(angle) for angle in range(0, 95, 5))


class ErrorProfiles:
    """Sums of squared errors over the pixels of many frames whose true depth is known, in bins with fixed edges.

    A pixel counts if the frame's own true depth is finite and the protocol compares both its colour and its depth. Its
    distance is that of the true surface, in ``unit``; pixels beyond the last edge are left out. Edges times ``scale``
    are :data:`DISTANCE_EDGES`.
    """

    def __init__(self, unit: str = "mm", scale: float = 1.0) -> None:
        self._distance = _Bins(unit, tuple(edge / scale for edge in DISTANCE_EDGES))
        self._angle = _Bins("degrees", ANGLE_EDGES)
        self._frames = 0

    def add(self, comparison: Comparison, frame: Frame) -> None:
        """Add the pixels of a frame; none where it has no true depth."""
        if frame.depth is None or comparison.depth is None or comparison.true_depth is None:
            return
        depth, compared = _float64(frame.depth), comparison.valid
        if comparison.depth_valid is not None:
            compared = compared & comparison.depth_valid
        counts = np.isfinite(depth) & compared.cpu().numpy()
        tangents = _tangents(frame.camera)
        rgb = np.square(_float64(comparison.rgb) - _float64(comparison.true_rgb)).mean(axis=-1)
        z = np.square(_float64(comparison.depth) - _float64(comparison.true_depth))
        self._distance.add((depth * np.hypot(1.0, tangents))[counts], rgb[counts], z[counts])
        self._angle.add(np.degrees(np.arctan(tangents))[counts], rgb[counts], z[counts])
        self._frames += 1

    def records(self) -> dict[str, ProfileRecord]:
        """Profiles over distance and angle; empty where no frame had true depth."""
        return {"distance": self._distance.record(), "angle": self._angle.record()} if self._frames else {}


class _Bins:
    def __init__(self, unit: str, edges: tuple[float, ...]) -> None:
        self.unit, self.edges = unit, edges
        self.pixels = np.zeros(len(edges) - 1, dtype=np.int64)
        self.rgb, self.depth = np.zeros(len(edges) - 1), np.zeros(len(edges) - 1)

    def add(self, where: Float[np.ndarray, "P"], rgb: Float[np.ndarray, "P"], depth: Float[np.ndarray, "P"]) -> None:
        """Add squared errors of pixels; a bin holds its lower edge."""
        index = np.searchsorted(self.edges, where, side="right") - 1
        inside = (index >= 0) & (index < len(self.pixels))
        index, bins = index[inside], len(self.pixels)
        self.pixels += np.bincount(index, minlength=bins)
        self.rgb += np.bincount(index, rgb[inside], bins)
        self.depth += np.bincount(index, depth[inside], bins)

    def record(self) -> ProfileRecord:
        """Means per bin."""
        return ProfileRecord(
            unit=self.unit,
            edges=self.edges,
            pixels=tuple(self.pixels.tolist()),
            rgb_mse=self._means(self.rgb),
            depth_mse=self._means(self.depth),
        )

    def _means(self, sums: Float[np.ndarray, "B"]) -> tuple[float | None, ...]:
        return tuple(
            float(total / count) if count and np.isfinite(total) else None
            for total, count in zip(sums, self.pixels, strict=True)
        )


def _tangents(camera: Camera) -> Float[np.ndarray, "H W"]:
    """Tangent of the angle between each pixel's ray and the optical axis. [H, W]"""
    rays = Camera.of(camera.intrinsics, torch.eye(4, dtype=torch.float64)).rays()
    return np.linalg.norm(rays[..., :2].numpy(), axis=-1)


def _float64(values: Tensor) -> Float[np.ndarray, "..."]:
    return values.detach().cpu().double().numpy()
