"""Points spread evenly over a mesh."""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Float, Int

from coliags_plugin.core.errors import InputError
from coliags_plugin.geometry.meshes.mesh import TriangleMesh


def sample_surface(
    mesh: TriangleMesh, count: int, part: Bool[np.ndarray, "F"] | None = None
) -> tuple[Float[np.ndarray, "N 3"], Int[np.ndarray, "N"]]:
    """Points uniform by area: one in each of N equal shares of it, in the order of the triangles.

    The same mesh has the same points.

    Args:
        mesh: Any mesh.
        count: Number of points, N.
        part: True for triangles to sample; None: all. [F]

    Returns:
        Points, float32 [N, 3], and the triangles they lie in [N].

    Raises:
        InputError: There is no area.
    """
    areas = mesh.areas if part is None else np.where(part, mesh.areas, 0.0)
    reached = np.cumsum(areas)
    if not len(reached) or not reached[-1] > 0.0:
        raise InputError("a surface without area", "triangles to sample")
    generator = np.random.default_rng(0)
    shares = (np.arange(count) + generator.random(count)) / count * reached[-1]
    chosen = np.minimum(np.searchsorted(reached, shares, side="right"), np.flatnonzero(areas)[-1])
    root, along = np.sqrt(generator.random(count)), generator.random(count)
    weights = np.stack([1.0 - root, root * (1.0 - along), root * along], axis=1)
    corners = mesh.vertices[mesh.triangles[chosen]]
    return np.asarray(np.einsum("nc,ncx->nx", weights, corners), np.float32), chosen
