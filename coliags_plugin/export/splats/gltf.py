"""GLB files of Gaussians: glTF 2.0 with the extension ``KHR_gaussian_splatting`` (ratified in January 2026)."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from coliags_plugin.core.files import atomic_write
from coliags_plugin.core.glb import GlbArray, encode_glb
from coliags_plugin.export.splats.cloud import SplatCloud

EXTENSION = "KHR_gaussian_splatting"
#: glTF's number of a primitive of points.
_POINTS = 0
#: Half a turn about x (x, y, z, w), from camera-like axes (y down, z forward) to glTF's (y up).
UPRIGHT = (1.0, 0.0, 0.0, 0.0)


def write_splat_glb(path: Path, cloud: SplatCloud, comment: str = "") -> None:
    """Write Gaussians as one primitive of points, float32, with the comment in ``asset.extras``.

    Attributes keep the world frame and unit of the cloud. The node turns them by half a turn about x, so that y is up
    as glTF has it. Readers without the extension see plain points in the colours of ``COLOR_0``.
    """
    attributes = _attributes(cloud)
    primitive = {
        "attributes": {name: index for index, name in enumerate(attributes)},
        "mode": _POINTS,
        "extensions": {EXTENSION: {"kernel": "ellipse", "colorSpace": "srgb_rec709_display"}},
    }
    document = {
        "extensionsUsed": [EXTENSION],
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0, "rotation": UPRIGHT}],
        "meshes": [{"primitives": [primitive]}],
    }
    arrays = [GlbArray(values, bounds=name == "POSITION") for name, values in attributes.items()]
    atomic_write(path, encode_glb(document, arrays, comment))


def _attributes(cloud: SplatCloud) -> dict[str, np.ndarray]:
    """Attributes by their names. [N, C] each"""
    opaque = np.clip(cloud.opacities, 0.0, 1.0)[:, None]
    named = {
        "POSITION": cloud.means,
        "COLOR_0": np.concatenate([cloud.colors, opaque], axis=1),
        f"{EXTENSION}:ROTATION": np.roll(cloud.unit_quats_wxyz, -1, axis=1),
        f"{EXTENSION}:SCALE": cloud.scales,
        f"{EXTENSION}:OPACITY": opaque,
    }
    for degree in range(cloud.degree + 1):
        for order in range(2 * degree + 1):
            coefficients = cloud.harmonics[:, degree * degree + order]
            named[f"{EXTENSION}:SH_DEGREE_{degree}_COEF_{order}"] = coefficients
    return {name: values.astype(np.float32) for name, values in named.items()}
