"""Sweeps and options of depth estimation."""

from __future__ import annotations

from typing import NamedTuple

from pydantic import Field

from coliags_plugin.core.settings import Settings
from coliags_plugin.reconstruction.structure.features import FeatureSettings


class Sweep(NamedTuple):
    """One sweep: matching and aggregation."""

    reduction: int = 1  # factor by which images are reduced
    step: float = 0.03  # relative difference of neighbouring hypotheses
    reach: float | None = None  # relative depth about that of the sweep before; None: the whole depth range
    #: Distances of the neighbours, in units of a frame's median depth; one frame to either side in the video for each.
    baselines: tuple[float, ...] = (0.05, 0.08, 0.12, 0.16, 0.2, 0.25)
    radius: int = 3  # half the width of the correlation windows, pixels
    small_penalty: float = 0.08  # semi-global penalty P1 of a change by one hypothesis; costs are in [0, 2]


#: One after the other; each but the first is about the completed depth of the one before, smoothed.
SWEEPS = (
    Sweep(reduction=2, radius=4),
    Sweep(step=0.01, reach=0.15, baselines=(0.05, 0.1, 0.2, 0.3, 0.4, 0.5), radius=2, small_penalty=0.01),
)
#: Largest distance of a neighbour, and largest angle between its optical axis and the frame's, degrees.
MAX_BASELINE, MAX_TURN = 0.6, 40.0


class DepthEstimationSettings(Settings):
    """Options of depth estimation."""

    agreement: float = Field(
        default=0.02, gt=0.0, lt=0.5, description="Relative difference up to which two frames' depths agree."
    )
    features: FeatureSettings = Field(
        default=FeatureSettings(), description="Features that the depth range is found from, and highlights."
    )
