"""Frames that read their pixels lazily from disk."""

from __future__ import annotations

from copy import copy
from dataclasses import dataclass, replace
from typing import Any

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


@dataclass(frozen=True)
class _Pixels:
    """Image, depth, masks and confidence of the working size, in the stored data types."""

    image: UInt8[np.ndarray, "H W 3"]
    depth: Shaped[np.ndarray, "H W"] | None
    mask: Bool[np.ndarray, "H W"] | None
    seen: Bool[np.ndarray, "H W"] | None
    confidence: UInt8[np.ndarray, "H W"] | None


class StoredFrame(Frame):
    """A lazily read frame, cached in the stored data types: 5 bytes per pixel with 16-bit depth.

    Thread-safe. Pixel attributes raise InputError if a file is damaged or has the wrong format or size. Without
    ``keep``, every attribute access reads its file; use :meth:`to` to get several attributes at once.
    """

    def __init__(self, shot: Shot, index: int, keep: bool = True) -> None:
        camera = shot.rectification.camera(shot.camera_to_world)
        values = {"name": shot.name, "index": index, "camera": camera, "sparse_depth": shot.sparse_depth}
        for name, value in {**values, "_shot": shot, "_keep": keep, "_pixels": None, "_scale": 1.0}.items():
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
        return torch.from_numpy(self._read().image if self._keep else _image(self._shot))

    @property
    def depth(self) -> Float[Tensor, "H W"] | None:
        """See :class:`Frame`; decoded each time."""
        return self._z_depth(self._stored_depth())

    @property
    def depth_at_least(self) -> Float[Tensor, "H W"] | None:
        """See :class:`Frame`; decoded each time."""
        return self._bound(self._stored_depth())

    @property
    def mask(self) -> Bool[Tensor, "H W"] | None:
        """See :class:`Frame`."""
        return _tensor(self._read().mask if self._keep else _mask(self._shot))

    @property
    def valid(self) -> Bool[Tensor, "H W"]:
        """See :class:`Frame`."""
        mask = self.mask
        return torch.ones(self.camera.height, self.camera.width, dtype=torch.bool) if mask is None else mask

    @property
    def seen(self) -> Bool[Tensor, "H W"] | None:
        """See :class:`Frame`."""
        return _tensor(self._read().seen if self._keep else _seen(self._shot))

    @property
    def depth_confidence(self) -> Float[Tensor, "H W"] | None:
        """See :class:`Frame`; decoded each time."""
        return _share(self._read().confidence if self._keep else _confidence(self._shot))

    def to(self, device: torch.device | str) -> Frame:
        """Decoded frame on a device; files are read once."""
        pixels = self._read()
        tensors = {
            "depth": self._z_depth(pixels.depth),
            "mask": _tensor(pixels.mask),
            "seen": _tensor(pixels.seen),
            "depth_at_least": self._bound(pixels.depth),
            "depth_confidence": _share(pixels.confidence),
        }
        image = torch.from_numpy(pixels.image)
        return Frame(self.name, self.index, image, self.camera, sparse_depth=self.sparse_depth, **tensors).to(device)

    def __repr__(self) -> str:
        return f"StoredFrame({self.name!r}, {str(self._shot.image)!r})"

    def _read(self) -> _Pixels:
        # If two threads read at the same time, the second overwrites the cache with equal data.
        if self._pixels is not None:
            return self._pixels
        shot, mask = self._shot, _mask(self._shot)
        pixels = _Pixels(_image(shot), _depth(shot, mask), mask, _seen(shot), _confidence(shot))
        if self._keep:
            object.__setattr__(self, "_pixels", pixels)
        return pixels

    def _stored_depth(self) -> Shaped[np.ndarray, "H W"] | None:
        return self._read().depth if self._keep else _depth(self._shot, _mask(self._shot))

    def _z_depth(self, stored: Shaped[np.ndarray, "H W"] | None) -> Float[Tensor, "H W"] | None:
        form = self._shot.depth_format
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

    def _bound(self, stored: Shaped[np.ndarray, "H W"] | None) -> Float[Tensor, "H W"] | None:
        form = self._shot.depth_format
        bound = None if stored is None or form is None else form.clipped_at(stored)
        return None if bound is None else _tensor(bound * np.float32(self._scale))

    _shot: Shot
    _keep: bool
    _pixels: _Pixels | None
    _scale: float  # of the frame's lengths, relative to those of the shot


def _image(shot: Shot) -> UInt8[np.ndarray, "H W 3"]:
    return shot.rectification.image(shot.rectification.checked(shot.image, read_rgb(shot.image)))


def _mask(shot: Shot) -> Bool[np.ndarray, "H W"] | None:
    valid = shot.rectification.valid
    if shot.mask is None:
        return valid
    own = shot.rectification.sampled(shot.mask, read_mask(shot.mask))
    return own if valid is None else own & valid


def _depth(shot: Shot, mask: Bool[np.ndarray, "H W"] | None) -> Shaped[np.ndarray, "H W"] | None:
    if shot.depth is None or shot.depth_format is None:
        return None
    depth = shot.rectification.sampled(shot.depth, shot.depth_format.read(shot.depth))
    return depth if mask is None else np.where(mask, depth, np.zeros((), depth.dtype))


def _seen(shot: Shot) -> Bool[np.ndarray, "H W"] | None:
    return None if shot.seen is None else shot.rectification.sampled(shot.seen, read_mask(shot.seen))


def _confidence(shot: Shot) -> UInt8[np.ndarray, "H W"] | None:
    if shot.confidence is None:
        return None
    stored = read_gray(shot.confidence, 8, "a one-channel 8-bit image of the confidence in depth, 255 = 1")
    return shot.rectification.sampled(shot.confidence, stored)


def _share(stored: UInt8[np.ndarray, "H W"] | None) -> Float[Tensor, "H W"] | None:
    """8-bit values in [0, 1], float32."""
    return None if stored is None else torch.from_numpy(stored.astype(np.float32) / np.float32(255.0))


def _tensor(array: np.ndarray | None) -> Tensor | None:
    return None if array is None else torch.from_numpy(array)
