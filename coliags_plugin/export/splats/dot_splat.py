"""``.splat`` files: 32 bytes a Gaussian, with colours that do not depend on the direction."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from coliags_plugin.core.errors import InputError
from coliags_plugin.core.files import atomic_write
from coliags_plugin.export.splats.cloud import SplatCloud, harmonics_of_colors

_ROW = np.dtype([("mean", "<f4", 3), ("scales", "<f4", 3), ("rgba", "u1", 4), ("quat", "u1", 4)])


def write_dot_splat(path: Path, cloud: SplatCloud, comment: str = "") -> None:
    """Write means, scales, 8-bit colours and opacities, and 8-bit rotations (w first, 128 (q + 1)), most visible first.

    The order is that of opacity times volume, falling, as viewers that draw while loading expect it. The format has no
    place for a comment.
    """
    order = np.argsort(-cloud.opacities * cloud.scales.prod(axis=1), kind="stable")
    rows = np.empty(len(cloud), _ROW)
    rows["mean"], rows["scales"] = cloud.means[order], cloud.scales[order]
    rgba = np.concatenate([cloud.colors, cloud.opacities[:, None]], axis=1)[order]
    rows["rgba"] = np.clip(np.round(255.0 * rgba), 0, 255)
    rows["quat"] = np.clip(np.round(128.0 * cloud.unit_quats_wxyz[order] + 128.0), 0, 255)
    atomic_write(path, rows.tobytes())


def read_dot_splat(path: Path) -> SplatCloud:
    """Read Gaussians with harmonics of degree 0."""
    try:
        data = path.read_bytes()
    except OSError as error:
        raise InputError(f"cannot read {path}: {error.strerror or error}", "a .splat file") from error
    if len(data) % _ROW.itemsize:
        raise InputError(f"{path} has {len(data)} bytes", f"a multiple of {_ROW.itemsize}, a .splat file")
    rows = np.frombuffer(data, _ROW)
    rgba = rows["rgba"].astype(np.float32) / 255.0
    return SplatCloud(
        means=rows["mean"].astype(np.float32),
        quats_wxyz=(rows["quat"].astype(np.float32) - 128.0) / 128.0,
        scales=rows["scales"].astype(np.float32),
        opacities=rgba[:, 3],
        harmonics=harmonics_of_colors(rgba[:, :3]),
    )
