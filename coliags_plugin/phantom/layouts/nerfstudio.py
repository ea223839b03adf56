"""nerfstudio's layout with a distorting lens (docs/layouts/nerfstudio.md)."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float

from coliags_plugin.datamanagers.nerfstudio.writer import write_frame, write_transforms
from coliags_plugin.geometry.lenses.models import Lens
from coliags_plugin.geometry.lenses.opencv import OpenCVLens
from coliags_plugin.phantom.layouts.base import Layout, Part, PhantomFrame

#: Millimetres per depth step: up to 655 mm.
DEPTH_UNIT = 0.01
#: A mild barrel distortion, so that missing undistortion is noticed.
_K1, _K2, _P1, _P2 = -0.2, 0.05, 0.001, -0.002


class NerfstudioLayout(Layout):
    """images/, depth/ and a transforms.json in millimetres with an OPENCV camera."""

    def lens(self, width: int, height: int) -> tuple[Lens, Bool[np.ndarray, "H W"]]:
        """The default camera with OpenCV's lens distortion."""
        plain, lit = super().lens(width, height)
        return OpenCVLens(**vars(plain.pinhole), k1=_K1, k2=_K2, p1=_P1, p2=_P2), lit

    def write_frame(self, folder: Path, frame: PhantomFrame) -> None:
        """See :class:`Layout`; normals are not part of this layout."""
        write_frame(folder, frame.index, frame.color, frame.z_depth, DEPTH_UNIT)

    def write_sequence(self, folder: Path, part: Part, poses: Sequence[Float[np.ndarray, "4 4"]], lens: Lens) -> None:
        """See :class:`Layout`."""
        if not isinstance(lens, OpenCVLens):
            raise TypeError("the nerfstudio layout needs OpenCV's lens model")
        write_transforms(folder, np.stack(poses), lens, DEPTH_UNIT)
