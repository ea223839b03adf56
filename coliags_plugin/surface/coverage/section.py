"""The section of a lumen that a recording is about: beyond its ends, surface that was not seen is no miss."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float
from scipy.ndimage import uniform_filter1d

from coliags_plugin.core.errors import InputError

#: Window over which the seen share of a ring is taken, mm, so that what lies behind a fold ends no section; and the
#: share that a ring of the section must have at its ends.
WINDOW, SHARE = 10.0, 0.5


@dataclass(frozen=True)
class Section:
    """From where to where along the centreline, mm."""

    start: float
    end: float

    def holds(self, arc: Float[np.ndarray, "N"]) -> Bool[np.ndarray, "N"]:
        """Which places are inside. [N]"""
        return np.asarray((arc >= self.start) & (arc <= self.end))

    @property
    def length(self) -> float:
        """From end to end, mm."""
        return self.end - self.start


def find_section(arc: Float[np.ndarray, "F"], areas: Float[np.ndarray, "F"], seen: Bool[np.ndarray, "F"]) -> Section:
    """From the first to the last place at which half of the wall was seen, over windows of 10 mm.

    Args:
        arc: Place of each triangle along the centreline, mm. [F]
        areas: Of the triangles, mm^2; those that are missing have to be among them. [F]
        seen: Which triangles were seen. [F]

    Raises:
        InputError: Nowhere was half of the wall seen.
    """
    first = float(np.floor(arc.min()))
    place = (arc - first).astype(int)
    whole = uniform_filter1d(np.bincount(place, areas).astype(float), int(WINDOW), mode="constant")
    found = uniform_filter1d(np.bincount(place, areas * seen).astype(float), int(WINDOW), mode="constant")
    half = np.flatnonzero((found >= SHARE * whole) & (whole > 0.0))
    if not len(half):
        raise InputError(
            "nowhere along the lumen was half of the wall seen",
            "a recording that shows a section of a lumen",
            "Check that the mesh is the wall that the camera filmed, in the world of its poses",
        )
    return Section(first + float(half[0]), first + float(half[-1]) + 1.0)
