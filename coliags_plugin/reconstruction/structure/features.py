"""SIFT features of endoscopic pictures: dark, soft, lit from the camera, and full of highlights."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Float32, UInt8
from pydantic import Field

from coliags_plugin.core.morphology import dilated
from coliags_plugin.core.settings import Settings


class FeatureSettings(Settings):
    """What is looked for in a picture. COLMAP's own defaults find a hundred points on a colon's wall."""

    local_contrast: float = Field(
        default=4.0,
        ge=0.0,
        description="Clip limit of the contrast-limited histogram equalisation that the grey picture goes through, on "
        "8 x 8 tiles; 0: none.",
    )
    peak_threshold: float = Field(
        default=0.001, gt=0.0, description="Least contrast of a feature, of 1. COLMAP's own is 0.0067."
    )
    max_features: int = Field(default=4000, ge=1, description="At most so many in a picture; the largest are kept.")
    upright: bool = Field(
        default=True,
        description="Features have no orientation: more of them match, as long as the camera rolls by less than some "
        "20 degrees between the pictures that are compared.",
    )
    highlight_level: int = Field(
        default=250, ge=1, le=256, description="Brightness, of 255, from which on a pixel is a highlight; 256: none is."
    )
    highlight_ratio: float = Field(
        default=1.5,
        gt=1.0,
        description="A pixel this many times as bright as its surroundings, and brighter by at least 20 of 255, is a "
        "highlight too: those move with the lamp.",
    )
    margin: int = Field(default=3, ge=0, description="Pixels around highlights and masks that yield no features.")


@dataclass(frozen=True, eq=False)
class Features:
    """What was found in one picture.

    Attributes:
        keypoints: Column, row, scale (pixels) and orientation (radians); pixel centres at integers + 0.5. [N, 4]
        descriptors: Of unit length. [N, 128]
    """

    keypoints: Float32[np.ndarray, "N 4"]
    descriptors: Float32[np.ndarray, "N 128"]

    @property
    def pixels(self) -> Float[np.ndarray, "N 2"]:
        """Column and row, pixel centres at integers + 0.5. float64. [N, 2]"""
        return self.keypoints[:, :2].astype(np.float64)

    def __len__(self) -> int:
        """Number of features."""
        return len(self.keypoints)


#: Finds the features of an RGB picture, leaving out what its mask, if any, has False.
Extractor = Callable[[UInt8[np.ndarray, "H W 3"], Bool[np.ndarray, "H W"] | None], Features]


def feature_extractor(settings: FeatureSettings) -> Extractor:
    """COLMAP's SIFT behind local contrast and masks; made once for many pictures.

    Call it within :func:`~coliags_plugin.reconstruction.structure.quiet.quiet_colmap`.
    """
    import cv2
    import pycolmap

    options = pycolmap.FeatureExtractionOptions()
    options.use_gpu = False
    options.sift.peak_threshold = settings.peak_threshold
    options.sift.max_num_features = settings.max_features
    options.sift.upright = settings.upright
    sift = pycolmap.FeatureExtractor.create(options, pycolmap.Device.cpu)
    local_contrast = cv2.createCLAHE(settings.local_contrast, (8, 8)) if settings.local_contrast else None

    def extract(image: np.ndarray, mask: np.ndarray | None) -> Features:
        gray = cv2.cvtColor(image, cv2.COLOR_RGB2GRAY)
        gray = gray if local_contrast is None else local_contrast.apply(gray)
        keypoints, descriptors = sift.extract_from_uint8_array(np.ascontiguousarray(gray))
        found = pycolmap.keypoints_to_matrix(keypoints).astype(np.float32).reshape(-1, 4)
        vectors = np.asarray(descriptors.data, np.float32).reshape(-1, 128)
        height, width = gray.shape
        column = np.clip(found[:, 0].astype(np.int64), 0, width - 1)
        row = np.clip(found[:, 1].astype(np.int64), 0, height - 1)
        kept = usable(image, mask, settings)[row, column]
        lengths = np.linalg.norm(vectors, axis=1, keepdims=True)
        return Features(found[kept], (vectors / np.maximum(lengths, 1e-12))[kept])

    return extract


def usable(
    image: UInt8[np.ndarray, "H W 3"], mask: Bool[np.ndarray, "H W"] | None, settings: FeatureSettings
) -> Bool[np.ndarray, "H W"]:
    """Where features may lie: away from highlights, which move with the lamp, and from what is masked. [H, W]"""
    excluded = highlights(image, settings)
    if mask is not None:
        excluded |= ~mask
    return ~dilated(excluded, settings.margin)


def highlights(image: UInt8[np.ndarray, "H W 3"], settings: FeatureSettings) -> Bool[np.ndarray, "H W"]:
    """Mirror reflections of the lamp: saturated, or much brighter than what is around. [H, W]"""
    import cv2

    brightest = image.max(axis=2)
    if settings.highlight_level > 255:
        return np.zeros(brightest.shape, bool)
    # Wide enough that a highlight never fills half of it.
    surroundings = cv2.medianBlur(brightest, 2 * (max(image.shape[:2]) // 25) + 1).astype(np.float32)
    standing_out = brightest > np.maximum(surroundings * settings.highlight_ratio, surroundings + 20.0)
    return np.asarray((brightest >= settings.highlight_level) | standing_out)
