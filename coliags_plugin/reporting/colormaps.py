"""Colour-mapped images of depth and errors, colour bars and rows of images. Arrays in, 8-bit RGB out.

Depth is drawn with viridis and errors with inferno, both perceptually uniform and easy to tell apart. A scale of errors
is for one set of frames, which it is stated beside.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from functools import cache
from typing import TYPE_CHECKING, Literal

import cv2
import numpy as np
from jaxtyping import Bool, Float, UInt8

from coliags_plugin.reporting.image_files import as_array
from coliags_plugin.reporting.numbers import linear_ticks, log_ticks, tick_label

if TYPE_CHECKING:
    from torch import Tensor

ColorMap = Literal["depth", "error"]

#: Percentiles of depth between which its colours run, median errors that a scale of errors spans, and pixels of a map
#: that enter either.
_DEPTH_PERCENTILES, _MEDIAN_ERRORS, _SAMPLED = (1.0, 99.0), 8.0, 20_000
#: Grey level of pixels of unknown depth.
UNKNOWN_GREY = 128
#: Grey levels of the hatching over error pixels without ground truth.
HATCH_GREYS = (150, 108)

#: Colour of text and lines.
INK = (32, 32, 32)
#: OpenCV's, with ASCII characters only.
_FONT = cv2.FONT_HERSHEY_SIMPLEX
_HATCH_PERIOD = 8
_HATCH_WIDTH = 2


@cache
def color_table(color_map: ColorMap) -> UInt8[np.ndarray, "256 3"]:
    """The 256 RGB colours of a colour map, from the lowest value to the highest. [256, 3]"""
    code = cv2.COLORMAP_VIRIDIS if color_map == "depth" else cv2.COLORMAP_INFERNO
    table: np.ndarray = cv2.applyColorMap(np.arange(256, dtype=np.uint8)[None], code)[0, :, ::-1].copy()
    table.setflags(write=False)
    return table


def colored(share: Float[np.ndarray, "*S"], color_map: ColorMap) -> UInt8[np.ndarray, "*S 3"]:
    """Colours of shares of the full scale, clipped to 0 to 1."""
    index = np.rint(np.clip(share, 0.0, 1.0) * 255.0).astype(np.uint8)
    return np.asarray(color_table(color_map)[index])


def colorize_depth(
    depth: Float[np.ndarray, "H W"] | Tensor, limits: tuple[float, float], hatched: bool = False
) -> UInt8[np.ndarray, "H W 3"]:
    """Colour-mapped depth of any kind, on a logarithmic scale: near is dark, far bright, not finite grey, or hatched.

    The limits are the depths of the first and the last colour, above 0 and in the unit of the depth; values beyond them
    are clipped.
    """
    depth = as_array(depth).astype(np.float64)
    finite = np.isfinite(depth)
    image = colored(scale_places(np.where(finite, depth, limits[0]), limits, "depth"), "depth")
    image[~finite] = hatch(*finite.shape)[~finite] if hatched else UNKNOWN_GREY
    return image


def depth_limits(depths: Iterable[Float[np.ndarray, "H W"] | Tensor]) -> tuple[float, float]:
    """Depths of the first and the last colour of the depth maps of one scene, in their unit: the low one is above 0.

    They are the 1st and the 99th percentile of what is finite and above 0, rounded outwards to two significant digits,
    so that neither the end of a lumen nor a speck before the lens takes the colours from the wall.
    """
    samples = [values.ravel()[:: math.ceil(values.size / _SAMPLED) or 1] for values in map(as_array, depths)]
    pooled = np.concatenate([*samples, np.zeros(0)]).astype(np.float64)
    pooled = pooled[np.isfinite(pooled) & (pooled > 0.0)]
    if not pooled.size:
        return 1.0, 10.0
    low, high = np.percentile(pooled, _DEPTH_PERCENTILES).tolist()
    low_step, high_step = (10.0 ** (math.floor(math.log10(end)) - 1) for end in (low, high))
    low = math.floor(low / low_step) * low_step
    return low, max(math.ceil(high / high_step) * high_step, low + low_step)


def depth_scale_text(limits: tuple[float, float], unit: str) -> str:
    """The scale of depth in words: ``12 to 85 mm, logarithmic``."""
    return f"{tick_label(limits[0])} to {tick_label(limits[1])} {unit}, logarithmic"


def scale_places(
    values: Float[np.ndarray, "*S"], limits: tuple[float, float], color_map: ColorMap
) -> Float[np.ndarray, "*S"]:
    """Places of values on a scale, 0 to 1, clipped to the limits: logarithmic for depth, for errors a square root.

    So that the errors of a good and of a bad method can both be seen.
    """
    low, high = limits
    values = np.clip(values, low, high)
    if color_map == "depth":
        return np.asarray(np.log(values / low) / math.log(high / low))
    return np.asarray(np.sqrt((values - low) / (high - low)))


def scale_ticks(limits: tuple[float, float], color_map: ColorMap) -> list[tuple[float, float]]:
    """Ticks of a scale and their places from 0 to 1: the limits, and round numbers at some distance from them."""
    low, high = limits
    if color_map == "error":
        inner = [share * high for share in (0.05, 0.2, 0.5)]
    else:
        inner = log_ticks(low, high) if high > 10.0 * low else linear_ticks(low, high)
    places = scale_places(np.array(inner, np.float64), limits, color_map).tolist()
    ticks = [(tick, place) for tick, place in zip(inner, places, strict=True) if 0.1 <= place <= 0.9]
    return [(low, 0.0), *ticks, (high, 1.0)]


def depth_error(
    rendered_mm: Float[np.ndarray, "H W"] | Tensor,
    true_mm: Float[np.ndarray, "H W"] | Tensor,
    valid: Bool[np.ndarray, "H W"] | Tensor | None = None,
) -> Float[np.ndarray, "H W"]:
    """Absolute depth error, mm, NaN where the truth is unknown or a pixel does not count. [H, W]

    Depths are of one kind, mm; NaN of the truth is unknown. ``valid`` masks the pixels that count. The error is
    infinite where only the rendering is not finite.
    """
    rendered, true = (as_array(depth).astype(np.float64) for depth in (rendered_mm, true_mm))
    counts = np.isfinite(true)
    if valid is not None:
        counts = counts & as_array(valid).astype(bool)
    error = np.full_like(true, np.nan)
    error[counts] = np.abs(rendered[counts] - true[counts])
    error[counts & ~np.isfinite(rendered)] = np.inf
    return error


def rgb_error(
    rendered: np.ndarray | Tensor,
    true: np.ndarray | Tensor,
    valid: Bool[np.ndarray, "H W"] | Tensor | None = None,
) -> Float[np.ndarray, "H W"]:
    """Mean over the channels of |rendered - true|, a fraction of full scale, NaN where a pixel does not count. [H, W]

    Colours are uint8, or floating point in [0, 1]. ``valid`` masks the pixels that count.
    """
    error: np.ndarray = np.abs(_unit_rgb(rendered) - _unit_rgb(true)).mean(axis=2)
    return error if valid is None else np.where(as_array(valid).astype(bool), error, np.nan)


def error_limit(errors: Iterable[Float[np.ndarray, "H W"]]) -> float:
    """End of the scale of the error maps of a set, in their unit: eight times their median, rounded up to two digits.

    Errors of zero and those that are not finite do not count.
    """
    samples = [error.ravel()[:: math.ceil(error.size / _SAMPLED) or 1] for error in errors]
    pooled = np.concatenate([*samples, np.zeros(0)])
    pooled = pooled[np.isfinite(pooled) & (pooled > 0.0)]
    if not pooled.size:
        return 1.0
    end = _MEDIAN_ERRORS * float(np.median(pooled))
    step = 10.0 ** (math.floor(math.log10(end)) - 1)
    return math.ceil(end / step) * step


def colorize_error(error: Float[np.ndarray, "H W"], limit: float) -> UInt8[np.ndarray, "H W 3"]:
    """Colour-mapped error of 0 to ``limit`` and more; where it is NaN, without ground truth, hatched in grey."""
    unknown = np.isnan(error)
    image = colored(scale_places(np.where(unknown, 0.0, error), (0.0, limit), "error"), "error")
    image[unknown] = hatch(*error.shape)[unknown]
    return image


def color_bar(
    limits: tuple[float, float], unit: str, color_map: ColorMap = "error", width: int = 480
) -> UInt8[np.ndarray, "H W 3"]:
    """Horizontal colour bar with ticks and unit (ASCII, as OpenCV's font has no other characters), on white."""
    left, right, top, size = 24, width - text_width(unit) - 32, 8, 18
    image = np.full((top + size + 26, width, 3), 255, np.uint8)
    image[top : top + size, left:right] = colored(np.linspace(0.0, 1.0, right - left)[None], color_map)
    for tick, place in scale_ticks(limits, color_map):
        x = left + round(place * (right - left - 1))
        cv2.line(image, (x, top + size), (x, top + size + 4), INK, 1)
        draw_text(image, tick_label(tick), (x, top + size + 20), align=0.5)
    draw_text(image, unit, (right + 20, top + size - 4))
    return image


def side_by_side(
    images: Sequence[UInt8[np.ndarray, "H W 3"] | Tensor], labels: Sequence[str]
) -> UInt8[np.ndarray, "Hs Ws 3"]:
    """Images of one height in a row on white, 8 px apart, each under its ASCII label."""
    arrays = [as_array(image) for image in images]
    band, gap, scale = 24, 8, 0.5
    height = band + arrays[0].shape[0]
    width = sum(array.shape[1] for array in arrays) + gap * (len(arrays) - 1)
    sheet = np.full((height, width, 3), 255, np.uint8)
    x = 0
    for label, array in zip(labels, arrays, strict=True):
        column = sheet[:, x : x + array.shape[1]]
        column[band:] = array
        # Drawn into a separate strip, so that a label ends where the next one begins.
        strip = np.ascontiguousarray(column[:band])
        draw_text(strip, label, (2, 16), scale)
        column[:band] = strip
        x += array.shape[1] + gap
    return sheet


def stacked(images: Sequence[UInt8[np.ndarray, "H W 3"]]) -> UInt8[np.ndarray, "Hs Ws 3"]:
    """Images below each other on white."""
    width = max(image.shape[1] for image in images)
    return np.concatenate(
        [np.pad(image, ((0, 0), (0, width - image.shape[1]), (0, 0)), constant_values=255) for image in images]
    )


def hatch(height: int, width: int) -> UInt8[np.ndarray, "H W 3"]:
    """Diagonal grey stripes, for pixels without ground truth. [H, W, 3]"""
    rows, columns = np.indices((height, width))
    stripe = (rows + columns) % _HATCH_PERIOD < _HATCH_WIDTH
    grey = np.where(stripe, HATCH_GREYS[1], HATCH_GREYS[0]).astype(np.uint8)
    return np.repeat(grey[:, :, None], 3, axis=2)


def _unit_rgb(values: np.ndarray | Tensor) -> np.ndarray:
    array = as_array(values)
    return array.astype(np.float64) / (255.0 if array.dtype == np.uint8 else 1.0)


def text_width(text: str, scale: float = 0.45) -> int:
    """Width of a text, px."""
    return int(cv2.getTextSize(text, _FONT, scale, 1)[0][0])


def draw_text(
    image: UInt8[np.ndarray, "H W 3"], text: str, origin: tuple[int, int], scale: float = 0.45, align: float = 0.0
) -> None:
    """Draw a text whose start (``align`` 0), middle (0.5) or end (1) is at the origin, on the line of its baseline."""
    start = (round(origin[0] - align * text_width(text, scale)), origin[1])
    cv2.putText(image, text, start, _FONT, scale, INK, 1, cv2.LINE_AA)
