"""Frames whose pixels are read when they are first asked for."""

from __future__ import annotations

import os
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float, Shaped, UInt8
from torch import Tensor

from coliags_plugin.datamanagers.images import read_mask, read_rgb
from coliags_plugin.datamanagers.recording import Shot
from coliags_plugin.progress import Progress
from coliags_plugin.scenes import Frame

#: Pictures read side by side at most: more threads than this wait for the disk.
_READERS = 8


@dataclass(frozen=True)
class _Pixels:
    """A working picture and what lies beside it, as small as it was stored."""

    image: UInt8[Tensor, "H W 3"]
    depth: Shaped[np.ndarray, "H W"] | None
    mask: Bool[Tensor, "H W"] | None
    seen: Bool[Tensor, "H W"] | None


class StoredFrame(Frame):
    """A frame on disk. What is read stays in memory in the type it was stored in: 5 bytes a pixel with 16-bit depth.

    Args:
        shot: The picture.
        index: Place in the video, counted from 0.
        keep: Whether pixels stay in memory once read; otherwise they are read each time.

    The attributes of pixels raise InputError where a file is damaged, of the wrong kind or of the wrong size.
    """

    def __init__(self, shot: Shot, index: int, keep: bool = True) -> None:
        values = {
            "name": shot.name,
            "index": index,
            "camera": shot.view.camera(shot.camera_to_world),
            "sparse_depth": shot.sparse_depth,
            "_shot": shot,
            "_keep": keep,
            "_pixels": None,
        }
        for name, value in values.items():
            object.__setattr__(self, name, value)

    @property
    def image(self) -> UInt8[Tensor, "H W 3"]:
        """See :class:`Frame`."""
        return self._read().image

    @property
    def depth(self) -> Float[Tensor, "H W"] | None:
        """See :class:`Frame`; decoded each time."""
        stored, form = self._read().depth, self._shot.depth_format
        return None if stored is None or form is None else torch.from_numpy(form.z_depth(stored))

    @property
    def depth_at_least(self) -> Float[Tensor, "H W"] | None:
        """See :class:`Frame`; decoded each time."""
        stored, form = self._read().depth, self._shot.depth_format
        bound = None if stored is None or form is None else form.clipped_at(stored)
        return None if bound is None else torch.from_numpy(bound)

    @property
    def mask(self) -> Bool[Tensor, "H W"] | None:
        """See :class:`Frame`."""
        return self._read().mask

    @property
    def seen(self) -> Bool[Tensor, "H W"] | None:
        """See :class:`Frame`."""
        return self._read().seen

    def __repr__(self) -> str:
        return f"StoredFrame({self.name!r}, {str(self._shot.image)!r})"

    def _read(self) -> _Pixels:
        if self._pixels is not None:
            return self._pixels
        pixels = _read_pixels(self._shot)
        if self._keep:
            object.__setattr__(self, "_pixels", pixels)
        return pixels

    _shot: Shot
    _keep: bool
    _pixels: _Pixels | None


def read_side_by_side(frames: Sequence[Frame], progress: Progress | None = None) -> None:
    """Have frames read their pixels now.

    Raises:
        InputError: For the first bad frame.
    """
    with ThreadPoolExecutor(min(_READERS, os.cpu_count() or 1)) as pool:
        pending = [pool.submit(lambda frame: bool(frame.image.numel()), frame) for frame in frames]
        try:
            for done, future in enumerate(pending, start=1):
                future.result()
                if progress is not None:
                    progress("read pictures", done, len(pending))
        except BaseException:
            pool.shutdown(cancel_futures=True)
            raise


def _read_pixels(shot: Shot) -> _Pixels:
    view = shot.view
    image = view.image(view.checked(shot.image, read_rgb(shot.image)))
    valid = view.valid
    if shot.mask is not None:
        own = view.nearest(view.checked(shot.mask, read_mask(shot.mask)))
        valid = own if valid is None else own & valid
    depth = None
    if shot.depth is not None and shot.depth_format is not None:
        depth = view.nearest(view.checked(shot.depth, shot.depth_format.read(shot.depth)))
        if valid is not None:
            depth = np.where(valid, depth, np.zeros((), depth.dtype))
    seen = None if shot.seen is None else view.nearest(view.checked(shot.seen, read_mask(shot.seen)))
    return _Pixels(
        torch.from_numpy(image),
        depth,
        None if valid is None else torch.from_numpy(valid),
        None if seen is None else torch.from_numpy(seen),
    )
