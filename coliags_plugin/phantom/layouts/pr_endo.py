"""PR-Endo's release of C3VD with EndoGSLAM's results (docs/layouts/c3vd-endogslam.md 2)."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float, UInt8

from coliags_plugin.datamanagers.c3vd_endogslam.files import OPTIMIZED, PARAMS
from coliags_plugin.lenses.models import Lens
from coliags_plugin.phantom.layouts.base import Layout, Part, WallPoints
from coliags_plugin.phantom.layouts.endogslam import EndoGSLAMLayout, write_params, write_prepared_frame

_DATA, _SCENE, _ITERATION = "C3VD", "phantom", 30_000
_SH0 = 0.28209479177387814


class PREndoLayout(Layout):
    """C3VD/phantom without poses, and beside it what EndoGSLAM, given all frames, made of it, as 3DGS PLY too."""

    default_size = EndoGSLAMLayout.default_size
    has_points = True

    def is_test(self, index: int) -> bool:
        """PR-Endo's: 7, 15, 23, ..."""
        return EndoGSLAMLayout().is_test(index)

    def lens(self, width: int, height: int) -> tuple[Lens, Bool[np.ndarray, "H W"]]:
        """As in EndoGSLAM's layout."""
        return EndoGSLAMLayout().lens(width, height)

    def write_frame(
        self,
        folder: Path,
        part: Part,
        index: int,
        color: UInt8[np.ndarray, "H W 3"],
        z_depth: Float[np.ndarray, "H W"],
        normals: Float[np.ndarray, "H W 3"],
    ) -> None:
        """See :class:`Layout`; normals are not part of this layout."""
        write_prepared_frame(folder / _DATA / _SCENE, index, color, z_depth)

    def write_sequence(self, folder: Path, part: Part, poses: Sequence[Float[np.ndarray, "4 4"]], lens: Lens) -> None:
        """See :class:`Layout`; poses stand in params.npz."""

    def write_points(
        self, folder: Path, points: WallPoints, poses: Sequence[Float[np.ndarray, "4 4"]], lens: Lens
    ) -> None:
        """See :class:`Layout`."""
        results = folder / f"{_DATA}{OPTIMIZED}" / _SCENE
        means = write_params(results / PARAMS, points, poses, lens)
        _write_gaussians(results / "point_cloud" / f"iteration_{_ITERATION}" / "point_cloud.ply", means, points.colors)

    def seen_mask(self, folder: Path, part: Part, index: int) -> Path:
        """Beside the pictures, where whoever is given the scene's own folder looks."""
        return super().seen_mask(folder / _DATA / _SCENE, part, index)


def _write_gaussians(path: Path, positions: Float[np.ndarray, "N 3"], colors: UInt8[np.ndarray, "N 3"]) -> None:
    """A PLY as 3D Gaussian splatting writes it, of the lowest degree."""
    columns = {name: positions[:, axis] for axis, name in enumerate("xyz")}
    columns |= {f"n{name}": np.zeros(len(positions)) for name in "xyz"}
    columns |= {f"f_dc_{channel}": (colors[:, channel] / 255.0 - 0.5) / _SH0 for channel in range(3)}
    columns |= {"opacity": np.full(len(positions), 4.0)}
    columns |= {f"scale_{axis}": np.full(len(positions), -1.2) for axis in range(3)}
    columns |= {f"rot_{axis}": np.full(len(positions), float(axis == 0)) for axis in range(4)}
    properties = "".join(f"property float {name}\n" for name in columns)
    header = f"ply\nformat binary_little_endian 1.0\nelement vertex {len(positions)}\n{properties}end_header\n"
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(header.encode() + np.stack(list(columns.values()), axis=1).astype("<f4").tobytes())
