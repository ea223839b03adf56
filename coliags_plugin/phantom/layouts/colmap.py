"""Images with a COLMAP sparse model (docs/layouts/colmap.md)."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from jaxtyping import Float

from coliags_plugin.core.images import write_image
from coliags_plugin.datamanagers.colmap.writer import SeenPoints, add_points
from coliags_plugin.datamanagers.units import write_unit
from coliags_plugin.geometry.lenses.models import Lens
from coliags_plugin.geometry.poses.colmap import colmap_poses, posed_model, write_reconstruction
from coliags_plugin.geometry.poses.rigid import inverse
from coliags_plugin.phantom.layouts.base import Layout, Part, PhantomFrame, WallPoints

#: A point is observed in one of this many images that show it, like a detected feature.
_SEEN_IN_ONE_OF = 3


class ColmapLayout(Layout):
    """images/, unit.txt and a binary model of one PINHOLE camera in sparse/0, its points with their images."""

    has_points = True

    def write_frame(self, folder: Path, frame: PhantomFrame) -> None:
        """See :class:`Layout`; depth is not part of this layout."""
        write_image(folder / "images" / _name(frame.index), frame.color)

    def write_sequence(self, folder: Path, part: Part, poses: Float[np.ndarray, "N 4 4"], lens: Lens) -> None:
        """See :class:`Layout`; poses are part of the model."""

    def write_points(self, folder: Path, points: WallPoints, poses: Float[np.ndarray, "N 4 4"], lens: Lens) -> None:
        """See :class:`Layout`. Points seen in fewer than two images are left out, as COLMAP leaves them out."""
        names = [_name(index) for index in range(len(poses))]
        model = posed_model(colmap_poses(poses), names, [lens.pinhole], [0] * len(poses))
        numbers = np.arange(len(points.positions))
        seen = [points.seen_in(index) & ((numbers + index) % _SEEN_IN_ONE_OF == 0) for index in range(len(poses))]
        kept = np.flatnonzero(np.sum(seen, axis=0) >= 2)
        observations = []
        for index, matrix in enumerate(inverse(poses)):
            indices = np.flatnonzero(seen[index][kept])
            local = points.positions[kept[indices]] @ matrix[:3, :3].T + matrix[:3, 3]
            observations.append(SeenPoints(lens.project(local), indices))
        add_points(model, observations, points.positions[kept], points.colors[kept])
        write_reconstruction(folder / "sparse/0", model)
        write_unit(folder, "mm")


def _name(index: int) -> str:
    return f"{index:04d}.png"
