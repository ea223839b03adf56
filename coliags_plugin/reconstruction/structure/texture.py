"""Texture of the colon's wall: log brightness, normalised locally, so that lamp, vignetting and gain drop out."""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Float32, UInt8

from coliags_plugin.core.arrays import dilated
from coliags_plugin.reconstruction.structure.features import FeatureSettings, highlights

#: Brightness, of 255, that is added before the logarithm, so that noise in the dark is not amplified without bound.
_DARK_OFFSET = 4.0
#: Standard deviations of the local mean, for detail and for folds, of the highlights' fill, of the denoising, pixels.
_DETAIL, _FOLDS, _FILL, _DENOISING = 10.0, 30.0, 4.0, 0.7
#: Least local deviation of the log brightness: flatter regions stay flat.
_LEAST_DEVIATION = 0.012
#: Local deviation up to which there is only the noise of 8-bit images.
_NOISE = 0.003
#: Grey levels per local deviation.
_GAIN = 42.0
#: Green from which tissue is overexposed, and brightness up to which a pixel is black.
_OVEREXPOSED, _BLACK = 235, 8
#: Brightness (of 255) of highlights, whose edges are sharp in any frame, and pixels about them that do not count.
_HIGHLIGHT, _HIGHLIGHT_MARGIN = 240, 5
#: The same where coarse detail is measured too, as of black pixels.
_COARSE_MARGIN = 12
#: Pixels around highlights and without texture that are not usable, and at the image's edge.
_MARGIN, _EDGE = 2, 4


def wall_textures(
    image: UInt8[np.ndarray, "H W 3"], mask: Bool[np.ndarray, "H W"] | None = None
) -> tuple[UInt8[np.ndarray, "H W"], UInt8[np.ndarray, "H W"], Bool[np.ndarray, "H W"]]:
    """Log brightness of an RGB image, normalised over short and over longer distances, and where it is of use.

    The first shows vessels and grain, to be located exactly; the second also folds, which tell large displacements.
    Both are 128 in the mean. Highlights are filled from around. Green and a little red are used: blood absorbs blue,
    and red saturates.
    """
    import cv2

    glints = dilated(highlights(image, FeatureSettings()), _MARGIN)
    excluded = glints if mask is None else glints | ~mask
    log = np.log(0.7 * image[..., 1].astype(np.float32) + 0.3 * image[..., 0] + _DARK_OFFSET)
    weight = (~excluded).astype(np.float32)
    around = cv2.GaussianBlur(log * weight, (0, 0), _FILL) / np.maximum(cv2.GaussianBlur(weight, (0, 0), _FILL), 1e-3)
    log = cv2.GaussianBlur(np.where(excluded, around, log), (0, 0), _DENOISING)
    detail, deviation = _normalised(log, _DETAIL)
    flat = (deviation < _NOISE) | (image[..., 1] > _OVEREXPOSED) | (image.max(axis=2) < _BLACK)
    usable = ~(excluded | dilated(flat, _MARGIN))
    usable[:_EDGE] = usable[-_EDGE:] = usable[:, :_EDGE] = usable[:, -_EDGE:] = False
    return detail, _normalised(log, _FOLDS)[0], usable


def _normalised(
    log: Float32[np.ndarray, "H W"], reach: float
) -> tuple[UInt8[np.ndarray, "H W"], Float32[np.ndarray, "H W"]]:
    """Difference from the local mean in units of the local standard deviation, as grey levels; and that deviation."""
    import cv2

    difference = log - cv2.GaussianBlur(log, (0, 0), reach)
    deviation = np.sqrt(cv2.GaussianBlur(difference * difference, (0, 0), reach))
    texture = np.clip(128.0 + _GAIN * difference / (deviation + _LEAST_DEVIATION), 0.0, 255.0).astype(np.uint8)
    return texture, deviation


def correlation_at(
    first: UInt8[np.ndarray, "H W"],
    second: UInt8[np.ndarray, "H W"],
    pixels: Float32[np.ndarray, "K 2"],
    moved: Float32[np.ndarray, "K 2"],
    reach: int = 5,
) -> Float32[np.ndarray, "K"]:
    """Normalised cross-correlation of the squares around pixels of one texture and around those of another. [K]

    Args:
        first: Texture of one image.
        second: Of the other.
        pixels: Column and row in the first, pixel centres at integers.
        moved: The same points in the second.
        reach: Half side of the squares, pixels.
    """
    patches = [_patches(texture, at, reach) for texture, at in ((first, pixels), (second, moved))]
    centred, partners = (patch - patch.mean(axis=1, keepdims=True) for patch in patches)
    power = np.sqrt((centred**2).sum(axis=1) * (partners**2).sum(axis=1))
    return np.asarray((centred * partners).sum(axis=1) / np.maximum(power, 1e-3))


def sharpness(gray: UInt8[np.ndarray, "h w"]) -> float:
    """Root mean square of the Laplacian of the smoothed image, relative to its mean brightness; 0 for a black image.

    Highlights do not count: they are sharp in a blurred frame too. Comparable between frames of one video only.
    """
    import cv2

    counted = ~dilated(gray >= _HIGHLIGHT, _HIGHLIGHT_MARGIN)
    brightness = float(gray[counted].mean()) if counted.any() else 0.0
    if brightness == 0.0:
        return 0.0
    edges = cv2.Laplacian(cv2.GaussianBlur(gray.astype(np.float32), (0, 0), 1.0), cv2.CV_32F)
    return float(np.sqrt(np.mean(np.square(edges[counted])))) / brightness


def fineness(gray: UInt8[np.ndarray, "h w"]) -> float:
    """Fine detail relative to coarse: root mean square Laplacians of log brightness, smoothed by 2 px and by 4 px.

    2 to 3.5 where an image is sharp; at a blur of 3 px 1.7, of 6 px 1.2; infinity without coarse detail. It does not
    depend on brightness or contrast, so that it tells a video that is blurred throughout.
    """
    import cv2

    counted = ~dilated((gray >= _HIGHLIGHT) | (gray < _BLACK), _COARSE_MARGIN)
    log = np.log(gray.astype(np.float32) + _DARK_OFFSET)
    smoothed = (cv2.GaussianBlur(log, (0, 0), sigma) for sigma in (2.0, 4.0))
    fine, coarse = (np.square(cv2.Laplacian(smooth, cv2.CV_32F)[counted]).sum() for smooth in smoothed)
    return float(np.sqrt(fine / coarse)) if coarse > 0.0 else float("inf")


def _patches(texture: np.ndarray, at: np.ndarray, reach: int) -> Float32[np.ndarray, "K P"]:
    import cv2

    offset = np.arange(-reach, reach + 1, dtype=np.float32)
    column, row = (grid.ravel() for grid in np.meshgrid(offset, offset))
    # cv2.remap takes at most 32,767 rows.
    parts = [
        cv2.remap(texture, part[:, :1] + column, part[:, 1:] + row, cv2.INTER_LINEAR).astype(np.float32)
        for part in np.array_split(at.astype(np.float32), len(at) // 30_000 + 1)
    ]
    return np.concatenate(parts)
