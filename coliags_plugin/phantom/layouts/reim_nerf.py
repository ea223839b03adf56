"""REIM-NeRF's layout of preprocessed C3VD (docs/layouts/reim-nerf.md)."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float

from coliags_plugin.datamanagers.reim_nerf.writer import ReimNerfWriter
from coliags_plugin.geometry.lenses.models import LENSES, FisheyeLens, Lens
from coliags_plugin.phantom.layouts.base import Layout, Part, PhantomFrame

#: Normalised units per mm. REIM-NeRF's own are 0.0092 to 0.0229, so that a scene lies between -1 and 1.
SCENE_SCALE = 0.0095
#: Normalised distance of the stored value 65535.
DISTMAP_SCALE = math.pi
#: The scene's middle, mm ahead of the path's.
_AHEAD = 30.0


class ReimNerfLayout(Layout):
    """Circular fisheye images, distance maps, rgb_mask.png, and a JSON file per part."""

    default_size = (1350, 1080)

    def __init__(self) -> None:
        self._writer: ReimNerfWriter | None = None

    def lens(self, width: int, height: int) -> tuple[Lens, Bool[np.ndarray, "H W"]]:
        """REIM-NeRF's lens, and the circle that its preprocessing keeps."""
        lens = _lens(width, height)
        # Its preprocessing counts pixel centres at integers.
        cx, cy = lens.pinhole.cx - 0.5, lens.pinhole.cy - 0.5
        radius = max(min(cx, width - cx), min(cy, height - cy)) - 20.0 * width / 1350.0
        column, row = np.meshgrid(np.arange(width), np.arange(height))
        return lens, np.hypot(column - cx, row - cy) <= radius

    def is_test(self, index: int) -> bool:
        """All but REIM-NeRF's training frames, its validation frames among them."""
        return index % 5 != 0 or _validates(index)

    def write_frame(self, folder: Path, frame: PhantomFrame) -> None:
        """See :class:`Layout`; normals are not part of this layout."""
        height, width = frame.z_depth.shape
        self._of(folder, width, height).write_frame(frame.index, frame.color, frame.z_depth)

    def write_sequence(self, folder: Path, part: Part, poses: Sequence[Float[np.ndarray, "4 4"]], lens: Lens) -> None:
        """See :class:`Layout`."""
        stacked = np.stack(poses)
        shift = -(stacked[:, :3, 3] + _AHEAD * stacked[:, :3, 2]).mean(axis=0)
        _, shows = self.lens(lens.width, lens.height)
        self._of(folder, lens.width, lens.height).write_sequence(stacked, shift, shows, _parts(len(poses)))

    def _of(self, folder: Path, width: int, height: int) -> ReimNerfWriter:
        """The writer of a folder, which keeps the depth range of each frame."""
        if self._writer is None or self._writer.folder != folder:
            self._writer = ReimNerfWriter(folder, _lens(width, height), SCENE_SCALE, DISTMAP_SCALE)
        return self._writer


def _lens(width: int, height: int) -> FisheyeLens:
    lens = LENSES["fisheye"].resized(width, height)
    if not isinstance(lens, FisheyeLens):
        raise TypeError("REIM-NeRF's lens is a fisheye")
    return lens


def _validates(index: int) -> bool:
    return index % 25 == 0 and index > 0


def _parts(count: int) -> dict[str, list[int]]:
    """REIM-NeRF's split: every fifth frame, of those every fifth but the first for validation."""
    fifth = range(0, count, 5)
    return {
        "train": [index for index in fifth if not _validates(index)],
        "val": [index for index in fifth if _validates(index)],
        "test": list(range(count)),
        "true_test": [index for index in range(count) if index % 5],
    }
