"""Pictures of depth errors on one scale for all frames, with a colour bar."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np
from jaxtyping import Float, UInt8

from coliags_plugin.checks.depth.check import DepthCheck
from coliags_plugin.checks.depth.pairing import true_depth_at
from coliags_plugin.checks.depth.sources import DepthMap, known_depth
from coliags_plugin.core.files import atomic_folder
from coliags_plugin.outputs.axis_ticks import round_up
from coliags_plugin.outputs.colormaps import UNKNOWN_GREY, color_bar, colorize_error
from coliags_plugin.outputs.image_files import write_png

#: Smallest width of a colour bar with legible ticks, px.
_BAR_WIDTH = 320
#: Smallest full scale, units of the truth.
_SMALLEST_LIMIT = 0.01


def error_limit(check: DepthCheck) -> float:
    """The error of the last colour, the same for all frames, units of the truth: the 90th percentile, rounded up."""
    length = None if check.dense is None else check.dense.errors.p90_length
    return round_up(max(length or 0.0, _SMALLEST_LIMIT))


def error_map(
    check: DepthCheck, estimate: DepthMap, truth: DepthMap, limit: float
) -> UInt8[np.ndarray, "H W 3"] | None:
    """|dz| of a frame, colour-mapped: hatched where the truth is unknown, plain grey where there is no estimate.

    Args:
        check: For its scale.
        estimate: Of the frame.
        truth: Of the frame.
        limit: The error of the last colour, units of the truth.

    Returns:
        The picture at the estimate's size; None where the truth has no dense depth. [H, W, 3]
    """
    true = true_depth_at(estimate, truth)
    if true is None or estimate.depth is None:
        return None
    known, there = np.isfinite(true), known_depth(estimate.depth)
    error: Float[np.ndarray, "H W"] = np.abs(estimate.depth * (1.0 if check.scale is None else check.scale) - true)
    image = colorize_error(np.where(there & known, error, 0.0), known, limit)
    image[known & ~there] = UNKNOWN_GREY
    return image


def error_maps(check: DepthCheck, limit: float) -> Iterator[tuple[str, UInt8[np.ndarray, "H W 3"]]]:
    """Names and error maps of all frames with dense truth; arguments as for :func:`error_map`."""
    for here, there in check.pairs.places:
        image = error_map(check, check.estimate.read(here), check.truth.read(there), limit)
        if image is not None:
            yield check.estimate.names[here], image


def write_error_maps(check: DepthCheck, folder: Path) -> None:
    """Write the error maps as ``NAME.png``, each above its colour bar; ``folder`` must be new or empty.

    Raises:
        InputError: The folder holds files, or cannot be written.
    """
    limit = error_limit(check)
    unit = f"|dz|, {'mm' if check.truth.metric else 'units'}"
    with atomic_folder(folder) as scratch:
        for name, image in error_maps(check, limit):
            write_png(scratch / f"{name}.png", _above_bar(image, color_bar((0.0, limit), unit, width=_BAR_WIDTH)))


def _above_bar(image: UInt8[np.ndarray, "H W 3"], bar: UInt8[np.ndarray, "h w 3"]) -> UInt8[np.ndarray, "Hs Ws 3"]:
    height, width = image.shape[:2]
    sheet = np.full((height + bar.shape[0], max(width, bar.shape[1]), 3), 255, np.uint8)
    sheet[:height, :width] = image
    sheet[height:, : bar.shape[1]] = bar
    return sheet
