"""Images as tables that bilinear interpolation reads once."""

from __future__ import annotations

from coliags_plugin.core.numba_kernels.compilation import Array, part


@part
def corners(image: Array, values: Array, start: int) -> None:
    """Write each pixel's value and those to the right, below and across, four numbers, from ``start`` on.

    Nothing is written for the last row and column.
    """
    height, width = image.shape
    for y in range(height - 1):
        for x in range(width - 1):
            at = start + 4 * (y * width + x)
            values[at], values[at + 1] = image[y, x], image[y, x + 1]
            values[at + 2], values[at + 3] = image[y + 1, x], image[y + 1, x + 1]
