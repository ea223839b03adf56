"""Frames that read their pixels lazily from disk."""

from __future__ import annotations

from collections.abc import Callable
from copy import copy
from dataclasses import replace
from typing import Any, cast

import numpy as np
import torch
from jaxtyping import Bool, Float, Shaped, UInt8
from torch import Tensor

from coliags_plugin.core import bounds
from coliags_plugin.core.errors import InputError
from coliags_plugin.core.images import read_rgb
from coliags_plugin.core.scenes import Frame
from coliags_plugin.datamanagers.reading.images import read_gray, read_mask
from coliags_plugin.datamanagers.recording import Shot


class StoredFrame(Frame):
    """A lazily read frame, cached in the stored data types: 5 bytes per pixel with 16-bit depth.

    Thread-safe. Pixel attributes raise InputError if a file is damaged or has the wrong format or size. Without
    ``keep``, every attribute access reads its file; use :meth:`to` to get several attributes at once.
    """

    def __init__(self, shot: Shot, index: int, keep: bool = True) -> None:
        camera = shot.rectification.camera(shot.camera_to_world)
        values = {"name": shot.name, "index": index, "camera": camera, "sparse_depth": shot.sparse_depth}
        for name, value in {**values, "_shot": shot, "_kept": {} if keep else None, "_scale": 1.0}.items():
            object.__setattr__(self, name, value)

    @property
    def shot(self) -> Shot:
        """Files, pose and camera of the frame, the pose in the frame's world."""
        pose = self._shot.camera_to_world.copy()
        pose[:3, 3] *= self._scale
        return replace(self._shot, camera_to_world=pose)

    def scaled(self, factor: float) -> Frame:
        """See :class:`Frame`."""
        frame, sparse = copy(self), self.sparse_depth
        changes: dict[str, Any] = {"camera": self.camera.scaled(factor), "_scale": factor * self._scale}
        changes["sparse_depth"] = None if sparse is None else sparse.scaled(factor)
        for name, value in changes.items():
            object.__setattr__(frame, name, value)
        return frame

    @property
    def image(self) -> UInt8[Tensor, "H W 3"]:
        """See :class:`Frame`."""
        return cast(Tensor, self._tensor("image"))

    @property
    def depth(self) -> Float[Tensor, "H W"] | None:
        """See :class:`Frame`; decoded each time."""
        stored, form = self._stored("depth"), self._shot.depth_format
        if stored is None or form is None:
            return None
        depth = form.z_depth(stored) * np.float32(self._scale)
        if ((depth <= 0.0) | (depth > bounds.LENGTH)).any():  # NaN is unknown
            raise InputError(
                f"{self._shot.depth}: depth reaches from {np.nanmin(depth):g} to {np.nanmax(depth):g} scene units",
                f"above 0, and at most {bounds.LENGTH:g}",
                "Correct the scale of depth",
            )
        return torch.from_numpy(depth)

    @property
    def depth_at_least(self) -> Float[Tensor, "H W"] | None:
        """See :class:`Frame`; decoded each time."""
        stored, form = self._stored("depth"), self._shot.depth_format
        bound = None if stored is None or form is None else form.clipped_at(stored)
        return None if bound is None else torch.from_numpy(bound * np.float32(self._scale))

    @property
    def mask(self) -> Bool[Tensor, "H W"] | None:
        """See :class:`Frame`."""
        return self._tensor("mask")

    @property
    def valid(self) -> Bool[Tensor, "H W"]:
        """See :class:`Frame`."""
        mask = self.mask
        return torch.ones(self.camera.height, self.camera.width, dtype=torch.bool) if mask is None else mask

    @property
    def seen(self) -> Bool[Tensor, "H W"] | None:
        """See :class:`Frame`."""
        return self._tensor("seen")

    @property
    def depth_confidence(self) -> Float[Tensor, "H W"] | None:
        """See :class:`Frame`; 8-bit values in [0, 1], decoded each time."""
        stored = self._stored("confidence")
        return None if stored is None else torch.from_numpy(stored.astype(np.float32) / np.float32(255.0))

    def to(self, device: torch.device | str) -> Frame:
        """Decoded frame on a device; files are read once."""
        frame = self if self._kept is not None else StoredFrame(self._shot, self.index).scaled(self._scale)
        parts = ("image", "depth", "mask", "seen", "depth_at_least", "depth_confidence")
        tensors = {part: getattr(frame, part) for part in parts}
        return Frame(self.name, self.index, camera=self.camera, sparse_depth=self.sparse_depth, **tensors).to(device)

    def read(self) -> None:
        """Read all files, and keep what is in them if the frame keeps anything."""
        for part in _READERS:
            self._stored(part)

    def __repr__(self) -> str:
        return f"StoredFrame({self.name!r}, {str(self._shot.image)!r})"

    def _stored(self, part: str) -> Shaped[np.ndarray, "H W ..."] | None:
        """A part of the working size, in the stored data type."""
        if self._kept is None:
            return _READERS[part](self)
        # If two threads read at the same time, the second overwrites the cache with equal data.
        if part not in self._kept:
            self._kept[part] = _READERS[part](self)
        return self._kept[part]

    def _tensor(self, part: str) -> Tensor | None:
        stored = self._stored(part)
        return None if stored is None else torch.from_numpy(stored)

    _shot: Shot
    _kept: dict[str, np.ndarray | None] | None  # by part; None if nothing is kept
    _scale: float  # of the frame's lengths, relative to those of the shot


def _image(frame: StoredFrame) -> UInt8[np.ndarray, "H W 3"]:
    shot = frame._shot
    return shot.rectification.image(shot.rectification.checked(shot.image, read_rgb(shot.image)))


def _mask(frame: StoredFrame) -> Bool[np.ndarray, "H W"] | None:
    shot, valid = frame._shot, frame._shot.rectification.valid
    if shot.mask is None:
        return valid
    own = shot.rectification.sampled(shot.mask, read_mask(shot.mask))
    return own if valid is None else own & valid


def _depth(frame: StoredFrame) -> Shaped[np.ndarray, "H W"] | None:
    shot = frame._shot
    if shot.depth is None or shot.depth_format is None:
        return None
    depth, mask = shot.rectification.sampled(shot.depth, shot.depth_format.read(shot.depth)), frame._stored("mask")
    return depth if mask is None else np.where(mask, depth, np.zeros((), depth.dtype))


def _seen(frame: StoredFrame) -> Bool[np.ndarray, "H W"] | None:
    shot = frame._shot
    return None if shot.seen is None else shot.rectification.sampled(shot.seen, read_mask(shot.seen))


def _confidence(frame: StoredFrame) -> UInt8[np.ndarray, "H W"] | None:
    shot = frame._shot
    if shot.confidence is None:
        return None
    stored = read_gray(shot.confidence, 8, "a one-channel 8-bit image of the confidence in depth, 255 = 1")
    return shot.rectification.sampled(shot.confidence, stored)


_READERS: dict[str, Callable[[StoredFrame], np.ndarray | None]] = {
    "image": _image,
    "depth": _depth,
    "mask": _mask,
    "seen": _seen,
    "confidence": _confidence,
}
