"""RGB-D frames prepared for registration: brightness normalised for the moving light, highlights masked."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import lru_cache

import cv2
import numpy as np
from jaxtyping import Bool, Float, Float32, UInt8

from coliags_plugin.core.errors import InputError
from coliags_plugin.core.morphology import dilated
from coliags_plugin.core.scenes import Frame
from coliags_plugin.reconstruction.structure.features import image_and_mask

#: Number of frames that the median depth is computed from.
_SAMPLED = 16
#: A pixel above this in every channel is a specular highlight.
_HIGHLIGHT = 200
#: Margin around a highlight, and standard deviation of the window that brightness is normalised over; shares of the
#: image's width. At 338 px they are 2 px and 8 px: of 5, 8, 15 and 30 px, 5 and 8 drifted least (docs/poses.md 11).
_HIGHLIGHT_MARGIN, _WINDOW = 0.006, 0.024
#: Noise floors of intensity and of contrast.
_DARK, _FLAT = 0.02, 0.02
#: Depth is interpolated only between known pixels; the tolerance is for rounding.
_ALL_KNOWN = 0.999
#: Local standard deviations that the range of normalised intensity spans.
_SPAN = 8.0


@dataclass(frozen=True, eq=False)
class RgbdFrame:
    """An RGB image with depth, without a pose."""

    name: str
    image: UInt8[np.ndarray, "H W 3"]
    depth: Float32[np.ndarray, "H W"]  # z-depth in any unit; not finite or not positive: unknown
    mask: Bool[np.ndarray, "H W"] | None = None  # False where a pixel is ignored; None: all are used


@dataclass(frozen=True, eq=False)
class PreparedFrame:
    """A frame ready for registration."""

    intensity: Float32[np.ndarray, "H W"]  # locally normalised brightness, 0 to 1, 0.5 at the local mean
    depth: Float32[np.ndarray, "H W"]  # in median depths of the video; 0: unknown, masked or a highlight


class RgbdVideo(Sequence[RgbdFrame]):
    """Images and depth of frames without their poses, read one at a time; every frame must have depth."""

    def __init__(self, frames: Sequence[Frame]) -> None:
        self._frames = frames

    def __len__(self) -> int:
        """Number of frames."""
        return len(self._frames)

    def __getitem__(self, index: int) -> RgbdFrame:  # type: ignore[override]  # no slices
        """Frame at an index."""
        frame = self._frames[index]
        if frame.depth is None:
            raise InputError(
                f"frame {frame.name} has no depth",
                "depth for every frame: RGB-D odometry registers surfaces and takes the unit of length from it",
                "Without depth use coliags poses sfm, which estimates poses from images alone",
            )
        image, mask = image_and_mask(frame)
        return RgbdFrame(frame.name, image, frame.depth.numpy(), mask)


def prepared_frames(
    video: Sequence[RgbdFrame], unit: float, keep: int, factor: int = 1
) -> Callable[[int], PreparedFrame]:
    """Function that prepares the frame at an index, and holds the ``keep`` most recently used.

    ``unit`` is the length that becomes 1, ``factor`` that on the frames' size.
    """

    @lru_cache(maxsize=keep)
    def prepared(index: int) -> PreparedFrame:
        frame = prepare(video[index], unit)
        return frame if factor == 1 else enlarged(frame, factor)

    return prepared


def prepare(frame: RgbdFrame, unit: float) -> PreparedFrame:
    """Normalise brightness locally, and set depth, in ``unit``, to 0 where masked, unknown or a highlight.

    The light source moves with the camera, so that the brightness of a surface point varies between frames by more
    than the texture's contrast; its ratio to neighbouring pixels does not. So the local mean of the logarithm of
    brightness is subtracted, and the result divided by the local standard deviation.
    """
    image, width = frame.image, frame.image.shape[1]
    valid = np.ones(image.shape[:2], bool) if frame.mask is None else frame.mask
    margin = max(1, round(_HIGHLIGHT_MARGIN * width))
    valid = valid & ~dilated(image.min(axis=2) > _HIGHLIGHT, margin)
    weight = valid.astype(np.float32)
    logarithm = np.log(cv2.cvtColor(image, cv2.COLOR_RGB2GRAY).astype(np.float32) / 255.0 + _DARK)
    blurred = _local_mean(weight, max(3.0, _WINDOW * width))
    contrast = logarithm - blurred(logarithm)
    deviation = np.sqrt(blurred(contrast**2) + _FLAT**2)
    intensity = np.where(valid, np.clip(0.5 + contrast / (_SPAN * deviation), 0.0, 1.0), 0.5)
    known = valid & np.isfinite(frame.depth) & (frame.depth > 0.0)
    depth = np.where(known, frame.depth / unit, 0.0)
    return PreparedFrame(intensity.astype(np.float32), depth.astype(np.float32))


def enlarged(frame: PreparedFrame, factor: int) -> PreparedFrame:
    """Upsampled frame; depth only where all interpolated pixels are known."""
    height, width = frame.depth.shape
    size = width * factor, height * factor
    known = cv2.resize((frame.depth > 0.0).astype(np.float32), size, interpolation=cv2.INTER_LINEAR)
    depth = cv2.resize(frame.depth, size, interpolation=cv2.INTER_LINEAR)
    return PreparedFrame(
        np.asarray(cv2.resize(frame.intensity, size, interpolation=cv2.INTER_CUBIC), np.float32),
        np.where(known > _ALL_KNOWN, depth, 0.0).astype(np.float32),
    )


def typical_depth(video: Sequence[RgbdFrame]) -> float:
    """Median known depth over frames sampled evenly from the video: the unit of the thresholds."""
    indices = np.unique(np.linspace(0, len(video) - 1, min(_SAMPLED, len(video))).round().astype(int))
    depths = [video[int(index)].depth[::4, ::4].ravel() for index in indices]
    known = np.concatenate(depths)
    known = known[np.isfinite(known) & (known > 0.0)]
    if not len(known):
        raise InputError(
            f"{len(indices)} of {len(video)} frames were sampled, and none has a pixel of known depth",
            "depth files that are not empty",
            "Check the depth folder and its scale",
        )
    return float(np.median(known))


def _local_mean(
    weight: Float32[np.ndarray, "H W"], deviation: float
) -> Callable[[np.ndarray], Float[np.ndarray, "H W"]]:
    """Gaussian-weighted local mean over the valid pixels."""
    share = cv2.GaussianBlur(weight, (0, 0), deviation) + 1e-6
    return lambda values: cv2.GaussianBlur(values * weight, (0, 0), deviation) / share
