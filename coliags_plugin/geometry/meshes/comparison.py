"""Comparison of a reconstructed mesh with the true surface (definitions: docs/meshes.md 4)."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Int

from coliags_plugin.core.errors import InputError
from coliags_plugin.geometry.meshes.mesh import TriangleMesh
from coliags_plugin.geometry.meshes.truth import TrueSurface

#: Distances within which a point counts as right, mm.
THRESHOLDS_MM = (0.5, 1.0, 2.0)
#: Points on each of the surfaces.
SAMPLES = 200_000
#: Median distance, as a share of the mesh's diagonal, above which the surfaces are not of one frame and unit.
_ELSEWHERE = 0.1
#: Points on the mesh that are looked at for that.
_FEW = 200


@dataclass(frozen=True)
class Score:
    """Shares of the reconstructed and of the seen true surface that lie within a distance of the other."""

    threshold_mm: float
    precision: float
    recall: float

    @property
    def f(self) -> float:
        """Harmonic mean of precision and recall."""
        total = self.precision + self.recall
        return 2.0 * self.precision * self.recall / total if total > 0.0 else 0.0


@dataclass(frozen=True)
class Direction:
    """Distances from points of one surface to the other surface, mm."""

    mean: float
    median: float
    percentile_95: float


@dataclass(frozen=True)
class SurfaceComparison:
    """How a reconstructed surface compares with the true one.

    Attributes:
        accuracy: From the reconstructed to the whole true surface.
        completeness: From the seen true to the reconstructed surface.
        scores: At each threshold.
        normal_error: Mean angle between the planes of the triangles at the reconstructed points and at the nearest
            true ones, degrees, 0 to 90.
        normal_error_median: Median of the same.
        beyond_seen: Share of the reconstructed surface whose nearest true triangle is not seen.
        seen_area: Area of the seen true surface, mm^2.
        seen_by: How it is known what was seen.
        samples: Points on each surface.
    """

    accuracy: Direction
    completeness: Direction
    scores: tuple[Score, ...]
    normal_error: float
    normal_error_median: float
    beyond_seen: float
    seen_area: float
    seen_by: str
    samples: int

    @property
    def chamfer(self) -> float:
        """Mean of the two mean distances (not their sum, not squared), mm."""
        return 0.5 * (self.accuracy.mean + self.completeness.mean)

    @property
    def hausdorff_95(self) -> float:
        """Larger of the two 95th percentiles, mm."""
        return max(self.accuracy.percentile_95, self.completeness.percentile_95)

    def f_at(self, threshold_mm: float) -> float:
        """F-score at one of the thresholds. Raises KeyError at another."""
        return {score.threshold_mm: score.f for score in self.scores}[threshold_mm]

    def as_json(self) -> dict[str, Any]:
        """All figures, those that follow from others included."""
        scores = [asdict(score) | {"f": score.f} for score in self.scores]
        return asdict(self) | {"scores": scores, "chamfer": self.chamfer, "hausdorff_95": self.hausdorff_95}


def sample_surface(
    mesh: TriangleMesh, count: int, part: Bool[np.ndarray, "F"] | None = None
) -> tuple[Float[np.ndarray, "N 3"], Int[np.ndarray, "N"]]:
    """Points uniform by area, one in each of ``count`` equal shares, float32, and the triangles they lie in.

    They are in the order of the triangles, and the same for the same mesh; of ``part`` only, where it is given.
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


def compare_meshes(mesh: TriangleMesh, truth: TrueSurface, samples: int = SAMPLES) -> SurfaceComparison:
    """Compare a reconstructed mesh with the true surface, in its world and mm, by points on both.

    Distances are between points, uniform by area, and the nearest point of any triangle of the other mesh. Invented
    surface costs accuracy and precision, wherever it is; what no camera saw costs no completeness or recall.

    Raises:
        InputError: A surface has no area, or the two lie apart or are of different size, as of another frame or unit.
    """
    _check_same_place(mesh, truth.mesh)
    points, triangles = sample_surface(mesh, samples)
    distances, nearest = truth.mesh.rays.nearest(points)
    seen_points, _ = sample_surface(truth.mesh, samples, truth.seen)
    gaps, _ = mesh.rays.nearest(seen_points)
    angles = angles_between(mesh.normals[triangles], truth.mesh.normals[nearest])
    return SurfaceComparison(
        accuracy=_direction(distances),
        completeness=_direction(gaps),
        scores=tuple(Score(t, float((distances <= t).mean()), float((gaps <= t).mean())) for t in THRESHOLDS_MM),
        normal_error=float(angles.mean()),
        normal_error_median=float(np.median(angles)),
        beyond_seen=float(1.0 - truth.seen[nearest].mean()),
        seen_area=float(truth.mesh.areas[truth.seen].sum()),
        seen_by=truth.seen_by,
        samples=samples,
    )


def angles_between(first: Float[np.ndarray, "N 3"], second: Float[np.ndarray, "N 3"]) -> Float[np.ndarray, "N"]:
    """Angle between planes of given unit normals, degrees, 0 to 90; the sides they point to do not matter. [N]"""
    return np.asarray(np.degrees(np.arccos(np.clip(np.abs((first * second).sum(axis=1)), 0.0, 1.0))))


def _direction(distances: Float[np.ndarray, "N"]) -> Direction:
    return Direction(float(distances.mean()), float(np.median(distances)), float(np.percentile(distances, 95)))


def _check_same_place(mesh: TriangleMesh, truth: TriangleMesh) -> None:
    size, true_size = _diagonal(mesh), _diagonal(truth)
    # Few points, as points far away take long.
    apart = float(np.median(truth.rays.nearest(sample_surface(mesh, _FEW)[0])[0]))
    if apart > _ELSEWHERE * size:
        raise InputError(
            f"a reconstructed surface {size:.3g} across whose median distance to the true one, {true_size:.3g} across, "
            f"is {apart:.3g}",
            "both in one world and unit",
            "Give the true surface of this very scene, in mm and in the world of its poses",
        )


def _diagonal(mesh: TriangleMesh) -> float:
    used = mesh.vertices[np.unique(mesh.triangles)]
    return float(np.linalg.norm(used.max(axis=0) - used.min(axis=0)))
