"""Evaluation of measured coverage against the truth, beside baselines that know nothing of the scene."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.spatial import cKDTree

from coliags_plugin.geometry.meshes.mesh import TriangleMesh
from coliags_plugin.geometry.meshes.truth import TrueSurface
from coliags_plugin.surface.coverage.centreline import LumenSection, find_centreline, find_section
from coliags_plugin.surface.coverage.measure import WallCoverage, large_regions, neighbours
from coliags_plugin.surface.coverage.views import CoverageView
from coliags_plugin.surface.coverage.visibility import Level, RayGrids, facing_cameras, see_faces


@dataclass(frozen=True)
class CoverageScores:
    """How well unseen surface, the positive class, was found; shares of area in [0, 1], None of no such surface."""

    face_iou: float | None  # intersection over union of predicted and true unseen surface
    # Intersection over union of each true region with the predicted regions that overlap it, other true regions left
    # out; mean weighted by area.
    region_iou: float | None
    mean_region_iou: float | None  # the same, every region counting alike
    region_recall: float | None  # share of the true regions of whose area at least half is predicted unseen
    recall: float | None  # share of the unseen surface that is called unseen
    precision: float | None  # share of the surface called unseen that is unseen
    false_positive_rate: float | None  # share of the seen surface that is called unseen
    false_omission_rate: float | None  # share of the surface called seen that is unseen
    true_regions: int  # their number, and that of the predicted ones
    predicted_regions: int

    @property
    def main_scores(self) -> dict[str, float | None]:
        """Those of texts and tables, by their names."""
        return {
            "face IoU": self.face_iou,
            "region IoU": self.region_iou,
            "region recall": self.region_recall,
            "recall": self.recall,
            "precision": self.precision,
            "false positive rate": self.false_positive_rate,
        }


def score_unseen(
    predicted: Bool[np.ndarray, "F"],
    true: Bool[np.ndarray, "F"],
    areas: Float[np.ndarray, "F"],
    pairs: Int[np.ndarray, "E 2"],
    smallest: float,
) -> CoverageScores:
    """Compare predicted with true unseen triangles; only regions larger than ``smallest`` mm^2 are regions.

    Triangles of area 0 do not count; ``pairs`` are those with a common edge.
    """
    counted = areas > 0.0
    predicted, true = predicted & counted, true & counted

    def share(part: Bool[np.ndarray, "F"], whole: Bool[np.ndarray, "F"]) -> float | None:
        total = float(areas[whole].sum())
        return float(areas[part & whole].sum()) / total if total else None

    truth = large_regions(true, pairs, areas, smallest)
    called = large_regions(predicted, pairs, areas, smallest)
    caught = [float(areas[region[predicted[region]]].sum()) >= 0.5 * float(areas[region].sum()) for region in truth]
    ious = _region_ious(truth, called, areas)
    return CoverageScores(
        face_iou=share(predicted & true, predicted | true),
        region_iou=float(np.average(ious, weights=[areas[region].sum() for region in truth])) if ious else None,
        mean_region_iou=float(np.mean(ious)) if ious else None,
        region_recall=float(np.mean(caught)) if caught else None,
        recall=share(predicted, true),
        precision=share(true, predicted),
        false_positive_rate=share(predicted, counted & ~true),
        false_omission_rate=share(true, counted & ~predicted),
        true_regions=len(truth),
        predicted_regions=len(called),
    )


def _region_ious(
    truth: Sequence[Int[np.ndarray, "K"]], called: Sequence[Int[np.ndarray, "K"]], areas: Float[np.ndarray, "F"]
) -> list[float]:
    """Of each true region with all predicted regions that overlap it, leaving out the surface of other true regions.

    The adjusted sIoU of Chan et al., SegmentMeIfYouCan, NeurIPS 2021 Datasets and Benchmarks.
    """
    owner = np.full(len(areas), -1)
    for number, region in enumerate(truth):
        owner[region] = number
    common, more = np.zeros(len(truth)), np.zeros(len(truth))
    for region in called:
        inside = region[owner[region] >= 0]
        overlap = np.bincount(owner[inside], areas[inside], minlength=len(truth))
        common += overlap
        more[overlap > 0.0] += areas[region[owner[region] < 0]].sum()
    whole = np.array([areas[region].sum() for region in truth])
    return [float(value) for value in common / (whole + more)]


#: Farthest that a triangle of the measured wall may be from the true one that it stands for, mm, in place and normal
#: together: the tolerance of the F-score of meshes, which is of place alone.
_REACH = 1.0
#: Weight of the difference of two unit normals in that distance, mm: the front of a fold does not stand for its back.
#: At one place, normals may be 29 degrees apart.
_NORMAL_WEIGHT = 2.0
#: Relative error of the distance along a viewing ray up to which the ray confirms the surface that it truly hits.
_SAME_DISTANCE = 0.25
#: Cells of the random baseline: along, mm, and around, degrees; and the number of draws that are averaged.
_CELL, _SECTOR, _DRAWS = 10.0, 30.0, 10


@dataclass(frozen=True)
class CoverageEvaluation:
    """Scores on the true surface, within the true section."""

    # Of the measured levels: true surface is called seen where the nearest reconstructed wall is, and lies within 1 mm
    # in place and normal: sqrt(distance^2 + (2 mm x difference of the unit normals)^2).
    surface: CoverageScores
    # Of the rule that a true triangle was seen where the measured wall is within 25 % of the distance along a viewing
    # ray that hits it.
    rays: CoverageScores
    all_unseen: CoverageScores  # of calling everything unseen
    random: CoverageScores  # of calling random cells unseen, of the same area as is truly unseen
    section: LumenSection  # the true section
    unseen_share: float  # share of it that is truly unseen

    def as_json(self) -> dict[str, Any]:
        """Scores by name."""
        return {
            "section_mm": [round(self.section.start, 2), round(self.section.end, 2)],
            "unseen_share": self.unseen_share,
            **{name: asdict(getattr(self, name)) for name in ("surface", "rays", "all_unseen", "random")},
        }


def evaluate_coverage(coverage: WallCoverage, truth: TrueSurface, views: Sequence[CoverageView]) -> CoverageEvaluation:
    """Compare measured coverage with the truth of the same world; what was seen is measured where it does not say."""
    mesh = facing_cameras(truth.mesh, views, coverage.settings)
    seen = truth.seen if truth.seen_by else see_faces(mesh, views, coverage.settings).seen
    line = find_centreline(mesh, [view.camera_to_world for view in views])
    arc, clock, _ = line.unroll(mesh.centers)
    along = (arc >= line.arc[0]) & (arc <= line.arc[-1])
    section = find_section(arc[along], mesh.areas[along], seen[along])
    areas = mesh.areas * section.holds(arc)
    unseen, pairs = ~seen, neighbours(mesh)

    def scored(called: Bool[np.ndarray, "F"]) -> CoverageScores:
        return score_unseen(called, unseen, areas, pairs, coverage.settings.region_area)

    share = float(areas[unseen].sum() / areas.sum())
    generator = np.random.default_rng(0)
    draws = [scored(_random_cells(arc, clock, share, generator)) for _ in range(_DRAWS)]
    return CoverageEvaluation(
        surface=scored(~_carried_over(coverage, mesh.centers, mesh.normals)),
        rays=scored(~_confirmed(coverage, mesh, views)),
        all_unseen=scored(np.ones(len(mesh), bool)),
        random=_mean(draws),
        section=section,
        unseen_share=share,
    )


def _carried_over(
    coverage: WallCoverage, centers: Float[np.ndarray, "F 3"], normals: Float[np.ndarray, "F 3"]
) -> Bool[np.ndarray, "F"]:
    """Whether the nearest reconstructed triangle of a like normal was seen; False where none is within reach. [F]"""
    seen = (coverage.level != Level.UNSEEN)[~coverage.guessed]
    own = coverage.mesh.part(~coverage.guessed)
    tree = cKDTree(np.concatenate([own.centers, _NORMAL_WEIGHT * own.normals], axis=1))
    queries = np.concatenate([centers, _NORMAL_WEIGHT * normals], axis=1)
    distance, nearest = tree.query(queries, distance_upper_bound=_REACH)
    within = np.isfinite(distance)
    called = np.zeros(len(centers), bool)
    called[within] = seen[np.asarray(nearest)[within]]
    return called


def _confirmed(coverage: WallCoverage, mesh: TriangleMesh, views: Sequence[CoverageView]) -> Bool[np.ndarray, "F"]:
    """Whether a viewing ray that hits a true triangle meets the reconstructed wall at about the same distance. [F]"""
    own = coverage.mesh.part(~coverage.guessed)
    grids, max_depth = RayGrids(coverage.settings.rays), coverage.settings.max_distance
    confirmed = np.zeros(len(mesh), bool)
    for view in views:
        rays = grids.of(view).world_rays(view)
        triangle, true = mesh.rays.cast(view.center, rays)
        hit = np.flatnonzero((triangle >= 0) & (true <= max_depth))
        _, measured = own.rays.cast(view.center, rays[hit])
        close = np.abs(measured - true[hit]) < _SAME_DISTANCE * true[hit]
        confirmed[triangle[hit[close]]] = True
    return confirmed


def _random_cells(
    arc: Float[np.ndarray, "F"], clock: Float[np.ndarray, "F"], share: float, generator: np.random.Generator
) -> Bool[np.ndarray, "F"]:
    """Cells of the wall, each chosen with the same probability. [F]"""
    sectors = int(360.0 / _SECTOR)
    cell = ((arc - arc.min()) / _CELL).astype(int) * sectors + (clock / _SECTOR).astype(int) % sectors
    return np.asarray((generator.random(cell.max() + 1) < share)[cell])


def _mean(draws: Sequence[CoverageScores]) -> CoverageScores:
    """Means of the scores of several draws; numbers of regions are rounded."""
    rows = [asdict(draw) for draw in draws]
    means: dict[str, Any] = {}
    for name in rows[0]:
        values = [float(value) for row in rows if (value := row[name]) is not None]
        means[name] = float(np.mean(values)) if values else None
    counts = {name: round(means[name]) for name in ("true_regions", "predicted_regions")}
    return CoverageScores(**{**means, **counts})
