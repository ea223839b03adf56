"""True surfaces of scenes, the part of them that the camera saw, and comparison with them (docs/meshes.md 4)."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Int

from coliags_plugin.core.arrays import read_arrays
from coliags_plugin.core.errors import InputError
from coliags_plugin.geometry.meshes.mesh import TriangleMesh, read_flagged_mesh

#: Where the truth of a scene lies in its folder: of phantoms, and C3VD's.
_PLACES = ("truth/mesh.ply", "coverage_mesh.obj")
#: C3VD's texture indices of triangles that were seen, and that were not.
_OBSERVED, _UNOBSERVED = 1, 2


@dataclass(frozen=True, eq=False)
class TrueSurface:
    """The true surface of a scene."""

    path: Path  # where it was read from
    mesh: TriangleMesh  # world frame of the scene
    seen: Bool[np.ndarray, "F"]  # True for triangles that the camera saw
    seen_by: str  # how that is known; empty where it is not, and ``seen`` is all True
    unit: str = "mm"  # of lengths: ``mm``, or ``units`` where it is unknown


def find_true_surface(scene: Path) -> Path | None:
    """File of the true surface in a scene's folder, if there is one: ``truth/mesh.ply`` or ``coverage_mesh.obj``."""
    return next((scene / name for name in _PLACES if (scene / name).is_file()), None)


def read_true_surface(path: Path) -> TrueSurface:
    """Read a true surface, of a mesh or of the folder of a scene with one, and what was seen of it.

    Seen are, of a phantom, the triangles of ``face_seen`` in ``mesh_seen.npz`` beside it: those that are the first hit
    of a pixel of a training frame. Of C3VD's ``coverage_mesh.obj``, those of texture index 1: observed in any frame.
    """
    if path.is_dir():
        surface = find_true_surface(path)
        if surface is None:
            raise InputError(f"{path} has no true surface", f"{' or '.join(_PLACES)} in it, or the path of a mesh")
        path = surface
    mesh, textures = read_flagged_mesh(path)
    flags = path.parent / "mesh_seen.npz"
    if path.suffix.lower() == ".ply" and flags.is_file():
        seen = read_arrays(flags, "an NPZ file with 'face_seen'", ["face_seen"])["face_seen"]
        if seen.shape != (len(mesh),) or seen.dtype != bool:
            raise InputError(
                f"{flags} has {seen.dtype} flags of shape {list(seen.shape)}",
                f"one bool for each of {len(mesh)} triangles",
            )
        return TrueSurface(path, mesh, seen, "first hit of a pixel of a training frame")
    if textures is not None and set(np.unique(textures)) <= {_OBSERVED, _UNOBSERVED}:
        seen = textures == _OBSERVED
        if not seen.any():
            raise InputError(f"{path} marks no triangle as seen", "vt 1 at the triangles that were observed")
        return TrueSurface(path, mesh, seen, "observed in any frame, by its vt 1")
    return TrueSurface(path, mesh, np.ones(len(mesh), bool), "")


#: Distances within which a point counts as right, scene units (mm).
THRESHOLDS = (0.5, 1.0, 2.0)
#: Points on each of the surfaces.
SAMPLES = 200_000
#: Median distance, as a share of the mesh's diagonal, above which the surfaces are not of one frame and unit.
_ELSEWHERE = 0.1
#: Points on the mesh that are looked at for that.
_FEW = 200


@dataclass(frozen=True)
class Score:
    """Shares of the reconstructed and of the seen true surface that lie within a distance of the other."""

    threshold: float
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
    """Comparison of a reconstructed surface with the true one."""

    accuracy: Direction  # from the reconstructed to the whole true surface
    completeness: Direction  # from the seen true to the reconstructed surface
    scores: tuple[Score, ...]  # at each threshold
    # Mean and median angle between the planes of the triangles at the reconstructed points and at the nearest true
    # ones, degrees, 0 to 90.
    normal_error: float
    normal_error_median: float
    beyond_seen: float  # share of the reconstructed surface whose nearest true triangle is not seen
    seen_area: float  # area of the seen true surface, mm^2
    seen_by: str  # how it is known what was seen
    unit: str  # as that of the true surface
    samples: int  # points on each surface

    @property
    def chamfer(self) -> float:
        """Mean of the two mean distances (not their sum, not squared), mm."""
        return 0.5 * (self.accuracy.mean + self.completeness.mean)

    @property
    def hausdorff_95(self) -> float:
        """Larger of the two 95th percentiles, mm."""
        return max(self.accuracy.percentile_95, self.completeness.percentile_95)

    def f_at(self, threshold: float) -> float:
        """F-score at one of the thresholds. Raises KeyError at another."""
        return {score.threshold: score.f for score in self.scores}[threshold]

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
    surface costs accuracy and precision, wherever it is; what no camera saw costs no completeness or recall. Surfaces
    that lie apart or are of different size, as of another frame or unit, are refused.
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
        scores=tuple(Score(t, float((distances <= t).mean()), float((gaps <= t).mean())) for t in THRESHOLDS),
        normal_error=float(angles.mean()),
        normal_error_median=float(np.median(angles)),
        beyond_seen=float(1.0 - truth.seen[nearest].mean()),
        seen_area=float(truth.mesh.areas[truth.seen].sum()),
        seen_by=truth.seen_by,
        unit=truth.unit,
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
