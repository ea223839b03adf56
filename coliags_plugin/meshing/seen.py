"""What the training views saw of a true surface."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from jaxtyping import Bool

from coliags_plugin.core.open3d_library import import_open3d
from coliags_plugin.core.scenes import Frame
from coliags_plugin.meshes.mesh import TriangleMesh


def first_hits(mesh: TriangleMesh, frames: Sequence[Frame]) -> Bool[np.ndarray, "F"]:
    """Triangles that are the first hit of the ray through the centre of an unmasked pixel of any frame. [F]

    Args:
        mesh: In the world of the poses.
        frames: The views.
    """
    open3d = import_open3d("casts rays at meshes")
    scene = open3d.t.geometry.RaycastingScene()
    scene.add_triangles(mesh.to_open3d())
    seen = np.zeros(len(mesh), bool)
    for frame in frames:
        camera = frame.camera.to("cpu", torch.float64)
        directions = camera.rays()[frame.valid.cpu()]
        rays = torch.cat([camera.center.expand_as(directions), directions], dim=1).float().numpy()
        hit = scene.cast_rays(open3d.core.Tensor(np.ascontiguousarray(rays)))["primitive_ids"].numpy()
        seen[hit[hit != scene.INVALID_ID]] = True
    return seen
