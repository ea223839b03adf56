"""Text drawn into images by OpenCV, whose font has ASCII characters only."""

from __future__ import annotations

import cv2
import numpy as np
from jaxtyping import UInt8

#: Colour of text and lines.
INK = (32, 32, 32)
_FONT = cv2.FONT_HERSHEY_SIMPLEX


def text_width(text: str, scale: float = 0.45) -> int:
    """Width of a text, px."""
    return int(cv2.getTextSize(text, _FONT, scale, 1)[0][0])


def draw_text(
    image: UInt8[np.ndarray, "H W 3"], text: str, origin: tuple[int, int], scale: float = 0.45, align: float = 0.0
) -> None:
    """Draw a text whose start (``align`` 0), middle (0.5) or end (1) is at the origin, on the line of its baseline."""
    start = (round(origin[0] - align * text_width(text, scale)), origin[1])
    cv2.putText(image, text, start, _FONT, scale, INK, 1, cv2.LINE_AA)
