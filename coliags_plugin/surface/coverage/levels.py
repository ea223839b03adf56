"""How well surface was seen, in four levels."""

from __future__ import annotations

from enum import IntEnum

import numpy as np
from jaxtyping import UInt8

from coliags_plugin.surface.coverage.settings import CoverageSettings
from coliags_plugin.surface.coverage.visibility import FaceViews


class Level(IntEnum):
    """How well a piece of surface was seen."""

    UNSEEN = 0
    POOR = 1
    GLANCE = 2
    SEEN = 3

    @property
    def label(self) -> str:
        """For legends and tables."""
        return _LABELS[self]

    @property
    def color(self) -> tuple[int, int, int]:
        """RGB of maps and meshes; told apart with any colour vision."""
        return _COLORS[self]


_LABELS = ("not seen", "seen too dark or too far", "seen only at a glance", "seen")
_COLORS = ((213, 62, 0), (95, 75, 139), (240, 200, 66), (150, 200, 190))
#: Not seen and not reconstructed either: a guess of where the surface is.
GUESS_LABEL = "not seen, place guessed"
GUESS_COLOR = (122, 20, 20)


def classify(views: FaceViews, settings: CoverageSettings) -> UInt8[np.ndarray, "F"]:
    """Level of each triangle, the values of :class:`Level`. [F]

    Seen: ``glance_frames`` frames or more saw it near and bright enough, at an angle to its normal of at most
    ``grazing``. At a glance: fewer did, but some saw it near and bright enough. Too dark or too far: no frame did.
    """
    level = np.full(len(views.frames), int(Level.UNSEEN), np.uint8)
    level[views.frames > 0] = Level.POOR
    level[views.clear_frames > 0] = Level.GLANCE
    level[views.good_frames >= settings.glance_frames] = Level.SEEN
    return level
