"""Writes COLMAP's layout: images, masks and a sparse model (docs/layouts/colmap.md)."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from jaxtyping import Float, Int, UInt8

if TYPE_CHECKING:
    import pycolmap


class SeenPoints(NamedTuple):
    """Observations of a model's points, by index from 0, in one image; pixel centres at integers + 0.5."""

    pixels: Float[np.ndarray, "K 2"]
    points: Int[np.ndarray, "K"]


def add_points(
    model: pycolmap.Reconstruction,
    seen: Sequence[SeenPoints],
    positions: Float[np.ndarray, "N 3"],
    colors: UInt8[np.ndarray, "N 3"],
) -> None:
    """Add points, in scene units, to a model of posed images; point k gets COLMAP's ID k + 1.

    ``seen`` are the observations of each image; image i has ID i + 1.
    """
    import pycolmap

    tracks = [pycolmap.Track() for _ in range(len(positions))]
    for number, here in enumerate(seen, start=1):
        model.images[number].points2D = pycolmap.Point2DList([pycolmap.Point2D(pixel) for pixel in here.pixels])
        for index, point in enumerate(here.points):
            tracks[point].add_element(number, index)
    for position, track, color in zip(positions, tracks, colors, strict=True):
        model.add_point3D(position, track, color)
    model.update_point_3d_errors()
