"""Options and sweeps of depth estimation, and images prepared for matching."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float32
from pydantic import Field

from coliags_plugin.core.scenes import Frame
from coliags_plugin.core.settings import Settings
from coliags_plugin.reconstruction.structure.features import FeatureSettings, image_and_mask, usable
from coliags_plugin.reconstruction.structure.matching import Pose


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


#: A value, and whether one counts, for every pixel of a frame.
Map = Float32[np.ndarray, "H W"]
Mask = Bool[np.ndarray, "H W"]

#: Added to intensity before the logarithm, which would amplify the noise of dark pixels.
_OFFSET = 0.02


@dataclass(frozen=True, eq=False)
class Guide:
    """An image prepared for matching."""

    pose: Pose  # camera of its size
    intensity: Map  # log of green; comparable up to a constant
    usable: Mask  # neither masked nor near a highlight


def guide_of(frame: Frame, reduction: int, features: FeatureSettings) -> Guide:
    """Prepare a frame, reduced by a factor, for matching; ``features`` says what a highlight is."""
    import cv2

    image, mask = image_and_mask(frame)
    good = usable(image, mask, features)
    height, width = good.shape
    # At least 8 pixels a side, unless it was smaller.
    size = max(min(8, width), round(width / reduction)), max(min(8, height), round(height / reduction))
    green = image[..., 1].astype(np.float32) / 255.0
    if reduction > 1:
        green = cv2.resize(green, size, interpolation=cv2.INTER_AREA)
        good = cv2.resize(good.astype(np.float32), size, interpolation=cv2.INTER_AREA) > 0.99
    intensity = np.log(green + _OFFSET).astype(np.float32)
    middle = float(intensity[good].mean()) if good.any() else 0.0
    return Guide(Pose.of(frame.camera, size), np.ascontiguousarray(intensity - np.float32(middle)), good)
