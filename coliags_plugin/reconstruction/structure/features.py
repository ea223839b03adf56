"""SIFT features of endoscopic images, with local contrast enhancement and specular highlights masked."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Float32, UInt8
from pydantic import Field

from coliags_plugin.core.arrays import dilated
from coliags_plugin.core.scenes import Frame
from coliags_plugin.core.settings import Settings


class FeatureSettings(Settings):
    """Options of SIFT extraction. COLMAP's defaults find about a hundred points on a colon's wall."""

    local_contrast: float = Field(
        default=4.0,
        ge=0.0,
        description="Clip limit of CLAHE (contrast-limited adaptive histogram equalisation) of the grey image, on "
        "8 x 8 tiles; 0: none.",
    )
    peak_threshold: float = Field(
        default=0.001, gt=0.0, description="SIFT peak (contrast) threshold. COLMAP's default is 0.0067."
    )
    max_features: int = Field(
        default=4000, ge=1, description="Largest number of features per image; those of the largest scale are kept."
    )
    upright: bool = Field(
        default=True,
        description="Upright SIFT, without orientation: more features match, as long as the camera rolls by less than "
        "about 20 degrees between matched images.",
    )
    highlight_level: int = Field(
        default=250, ge=1, le=256, description="Brightness (of 255) from which a pixel is a highlight; 256: none is."
    )
    highlight_ratio: float = Field(
        default=1.5,
        gt=1.0,
        description="A pixel this many times as bright as its surroundings, and brighter by at least 20 of 255, is "
        "also a highlight; highlights move with the light source.",
    )
    margin: int = Field(default=3, ge=0, description="Dilation of highlights and masks, pixels.")


@dataclass(frozen=True, eq=False)
class Features:
    """Keypoints and descriptors of one image."""

    keypoints: Float32[np.ndarray, "N 4"]  # column, row (centres at integers + 0.5), scale; angle, radians
    descriptors: Float32[np.ndarray, "N 128"]  # L2-normalised

    @property
    def pixels(self) -> Float[np.ndarray, "N 2"]:
        """Column and row, pixel centres at integers + 0.5; float64."""
        return self.keypoints[:, :2].astype(np.float64)

    def __len__(self) -> int:
        """Number of features."""
        return len(self.keypoints)


def image_and_mask(frame: Frame) -> tuple[UInt8[np.ndarray, "H W 3"], Bool[np.ndarray, "H W"] | None]:
    """A frame's RGB image and its mask, if any."""
    return frame.image.cpu().numpy(), None if frame.mask is None else frame.mask.cpu().numpy()


#: Extracts the features of an RGB image where its mask, if any, is True.
Extractor = Callable[[UInt8[np.ndarray, "H W 3"], Bool[np.ndarray, "H W"] | None], Features]


def feature_extractor(settings: FeatureSettings) -> Extractor:
    """Create a reusable feature extractor: CLAHE, COLMAP's SIFT, and rejection of masked features.

    Call it within :func:`quiet_colmap`.
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
        points = pycolmap.keypoints_to_matrix(keypoints).astype(np.float32).reshape(-1, 4)
        vectors = np.asarray(descriptors.data, np.float32).reshape(-1, 128)
        height, width = gray.shape
        column = np.clip(points[:, 0].astype(np.int64), 0, width - 1)
        row = np.clip(points[:, 1].astype(np.int64), 0, height - 1)
        is_usable = usable(image, mask, settings)[row, column]
        lengths = np.linalg.norm(vectors, axis=1, keepdims=True)
        return Features(points[is_usable], (vectors / np.maximum(lengths, 1e-12))[is_usable])

    return extract


def usable(
    image: UInt8[np.ndarray, "H W 3"], mask: Bool[np.ndarray, "H W"] | None, settings: FeatureSettings
) -> Bool[np.ndarray, "H W"]:
    """Pixels where features are accepted: neither masked nor near a highlight."""
    excluded = highlights(image, settings)
    if mask is not None:
        excluded |= ~mask
    return ~dilated(excluded, settings.margin)


def highlights(image: UInt8[np.ndarray, "H W 3"], settings: FeatureSettings) -> Bool[np.ndarray, "H W"]:
    """Specular highlights: pixels that are saturated or much brighter than their surroundings."""
    import cv2

    brightest = image.max(axis=2)
    if settings.highlight_level > 255:
        return np.zeros(brightest.shape, bool)
    # The window is wide enough that a highlight never fills half of it.
    surroundings = cv2.medianBlur(brightest, 2 * (max(image.shape[:2]) // 25) + 1).astype(np.float32)
    is_outlier = brightest > np.maximum(surroundings * settings.highlight_ratio, surroundings + 20.0)
    return np.asarray((brightest >= settings.highlight_level) | is_outlier)


#: glog's level FATAL.
_FATAL = 3


@contextmanager
def quiet_colmap(seed: int) -> Iterator[None]:
    """Silence COLMAP's log and seed its global random generator."""
    import pycolmap

    level = pycolmap.logging.minloglevel
    pycolmap.logging.minloglevel = _FATAL
    pycolmap.set_random_seed(seed)
    try:
        yield
    finally:
        pycolmap.logging.minloglevel = level
