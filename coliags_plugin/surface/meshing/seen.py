"""What the training views saw of a true surface."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from jaxtyping import Bool

from coliags_plugin.core.scenes import Frame
from coliags_plugin.geometry.meshes.mesh import TriangleMesh


def first_hits(mesh: TriangleMesh, frames: Sequence[Frame]) -> Bool[np.ndarray, "F"]:
    """Triangles that are the first hit of the ray through the centre of an unmasked pixel of any frame. [F]

    Args:
        mesh: In the world of the poses.
        frames: The views.
    """
    seen = np.zeros(len(mesh), bool)
    for frame in frames:
        camera = frame.camera.to("cpu", torch.float64)
        directions = camera.rays()[frame.valid.cpu()]
        hit, _ = mesh.rays.cast(camera.center.numpy(), directions.numpy())
        seen[hit[hit >= 0]] = True
    return seen
