"""Depth from brightness: with the lamp at the lens, what is farther away is darker."""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Float, Float32, UInt8

from coliags_plugin.core.scenes import Frame
from coliags_plugin.reconstruction.depth.priors import DepthPrior
from coliags_plugin.reconstruction.depth.robust_fit import robust_fit
from coliags_plugin.reconstruction.depth.views import Pose

#: Exponent from stored to linear intensity, and the least linear intensity.
_GAMMA, _DARKEST = 2.2, 2e-4
#: Standard deviations of smoothing, pixels; the last that reaches usable pixels counts.
_SIGMAS = (24.0, 6.0, 1.5)
#: Weight of the physical law, in pixels: what a frame with few known depths falls back to.
_LAW_WEIGHT = 20.0


class LightPrior(DepthPrior):
    """Log depth as a polynomial of log red, log green and the cosine to the optical axis, fitted to each frame.

    Seven numbers: constant, both logarithms, their squares and product, and the cosine. Where depth is hardly known
    the fit stays at the law of a lamp at the lens, intensity ~ 1 / depth^2 (docs/depth.md).
    """

    def log_depth(
        self,
        frame: Frame,
        usable: Bool[np.ndarray, "H W"],
        known: Float32[np.ndarray, "H W"],
        weight: Float32[np.ndarray, "H W"],
        typical: float,
    ) -> Float32[np.ndarray, "H W"]:
        """See :class:`DepthPrior`."""
        import cv2

        size = (known.shape[1], known.shape[0])
        image = cv2.resize(frame.image.cpu().numpy(), size, interpolation=cv2.INTER_AREA)
        design = light_terms(image, usable, Pose.resized(frame.camera, size))
        columns = design.reshape(-1, design.shape[-1])
        chosen = np.flatnonzero((weight > 0.0) & usable)
        law = np.zeros(columns.shape[1])
        law[2] = -0.5
        lit = columns[usable.ravel()] if usable.any() else columns
        law[0] = np.log(typical) - law[2] * float(np.median(lit[:, 2]))
        fitted = robust_fit(columns[chosen], known.ravel()[chosen], weight.ravel()[chosen], law, _LAW_WEIGHT)
        # Beyond what the fit has seen, a polynomial runs away: hold its terms at the ends.
        if len(chosen) > 1000:
            low, high = np.percentile(columns[chosen], [0.05, 99.95], axis=0)
            slack = 0.15 * (high - low)
            columns = np.clip(columns, low - slack, high + slack)
        return np.asarray((columns @ fitted).reshape(known.shape), np.float32)

    def described(self) -> str:
        """See :class:`DepthPrior`."""
        return "light"


def light_terms(
    image: UInt8[np.ndarray, "H W 3"], usable: Bool[np.ndarray, "H W"], pose: Pose
) -> Float[np.ndarray, "H W 7"]:
    """Terms of the polynomial: 1, log red, log green, their squares and product, cosine to the optical axis.

    Colours are smoothed over a few pixels, without those that are not usable; these take the colours around them.
    """
    import cv2

    linear = (image[..., :2].astype(np.float32) / 255.0) ** _GAMMA
    good = usable.astype(np.float32)
    smooth = linear
    for sigma in _SIGMAS:
        share = cv2.GaussianBlur(good, (0, 0), sigma)[..., None]
        around = cv2.GaussianBlur(linear * good[..., None], (0, 0), sigma) / np.maximum(share, 1e-3)
        smooth = np.where(share > 0.05, around, smooth)
    red, green = np.moveaxis(np.log(np.maximum(smooth, _DARKEST)).astype(np.float64), -1, 0)
    cosine = 1.0 / np.linalg.norm(pose.rays(), axis=-1)
    return np.stack([np.ones_like(red), red, green, red * red, red * green, green * green, cosine], axis=-1)
