"""Writing pictures."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np

from coliags_plugin.core.errors import InputError


def write_image(path: Path, image: np.ndarray) -> None:
    """Write RGB or grey, 8 or 16 bit, as the suffix says.

    Raises:
        InputError: It cannot be written.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    if image.ndim == 3:
        image = np.ascontiguousarray(image[..., ::-1])
    if not cv2.imwrite(str(path), image):
        raise InputError(f"cannot write {path}", "a writable folder on a disk with room", "Choose another output")
