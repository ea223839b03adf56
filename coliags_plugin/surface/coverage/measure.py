"""Coverage of a recording: how each piece of the wall was seen, and the connected regions that were missed."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float, Int, UInt8
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from coliags_plugin.geometry.meshes.mesh import TriangleMesh
from coliags_plugin.surface.coverage.centreline import (
    STEP,
    Centreline,
    LumenSection,
    NoLumenError,
    TubeGrid,
    find_centreline,
    find_section,
    guessed_wall,
    wall_around,
)
from coliags_plugin.surface.coverage.visibility import (
    CoverageSettings,
    CoverageView,
    FaceViews,
    Level,
    classify,
    facing_cameras,
    see_faces,
)

#: Guessed wall continues a region of reconstructed wall whose centroids are as near as this, mm.
_TOUCHING = 2.0
#: Points of a region that choose its picture, and a distance within which views are alike for that, mm.
_SAMPLES, _NEAR = 200, 20.0


@dataclass(frozen=True, eq=False)
class MissedRegion:
    """A connected piece of the section that no frame shows."""

    triangles: Int[np.ndarray, "K"]  # indices in :attr:`WallCoverage.mesh`
    area: float  # mm^2
    guessed_area: float  # area of it whose place is a guess, mm^2
    centroid: Float[np.ndarray, "3"]  # world, mm
    arc: float  # place of the centroid along the centreline, mm
    clock: float  # clock angle of the centroid, degrees; 0 is up
    reach: tuple[float, float]  # from where to where along the centreline, mm
    at_end: bool  # whether it reaches an end of the section, beyond which nothing is counted
    nearest: int  # index of the frame that looks where it is from nearest, whether it is hidden there or not

    @property
    def diameter(self) -> float:
        """Diameter of the circle of the same area, mm."""
        return float(2.0 * np.sqrt(self.area / np.pi))


@dataclass(frozen=True, eq=False)
class SeenWall:
    """Wall of F triangles, and how a recording shows it."""

    mesh: TriangleMesh  # the reconstructed wall and, behind it in the order of triangles, the guessed wall
    guessed: Bool[np.ndarray, "F"]  # triangles whose place is a guess, because nothing was reconstructed there
    views: FaceViews  # how the frames saw each triangle; guessed ones are unseen
    level: UInt8[np.ndarray, "F"]  # the values of :class:`Level`
    names: list[str]  # of the frames
    settings: CoverageSettings  # what counts as seen well
    metric: bool  # whether lengths are mm; else their unit is unknown

    @property
    def inside(self) -> Bool[np.ndarray, "F"]:
        """Triangles that are measured. [F]"""
        return np.ones(len(self.mesh), bool)

    def area(self, chosen: Bool[np.ndarray, "F"] | None = None) -> float:
        """Area of some of the measured triangles, or of all, in square units of the mesh."""
        return float(self.mesh.areas[self.inside if chosen is None else chosen & self.inside].sum())


@dataclass(frozen=True, eq=False)
class PartialCoverage(SeenWall):
    """Coverage of the reconstructed wall alone, where no section of a lumen can be measured."""

    reason: str  # why there is no section


@dataclass(frozen=True, eq=False)
class WallCoverage(SeenWall):
    """Coverage of a section of a lumen, mm, and the regions that a recording misses there."""

    line: Centreline  # of the lumen
    arc: Float[np.ndarray, "F"]  # place of each triangle along the centreline, mm
    clock: Float[np.ndarray, "F"]  # clock angle of each triangle, degrees
    section: LumenSection  # what part of the lumen is measured
    grid: TubeGrid  # the wall, guessed or not, around the centreline
    regions: Sequence[MissedRegion] = ()  # of the section, the largest first

    @property
    def inside(self) -> Bool[np.ndarray, "F"]:
        """Triangles of the section. [F]"""
        return self.section.holds(self.arc)


def measure_coverage(
    mesh: TriangleMesh, views: Sequence[CoverageView], settings: CoverageSettings, metric: bool = True
) -> WallCoverage | PartialCoverage:
    """Measure what a recording shows of the wall of a lumen, in the world frame and mm, and what it misses.

    Where the mesh has no wall, a guess of it closes the lumen (:func:`guessed_wall`), since only surface that is there
    can be called unseen; guessed wall always is. Without a lumen, or in a unit that is not mm (``metric``), what was
    seen of the mesh is measured alone, then without the limits in mm.
    """
    if not metric:
        settings = settings.model_copy(update={"max_distance": np.inf, "far": np.inf})
    mesh = facing_cameras(mesh, views, settings)
    face_views = see_faces(mesh, views, settings)
    try:
        if metric:
            return _along_lumen(mesh, face_views, views, settings)
        reason = "the unit of length is unknown"
    except NoLumenError as error:
        reason = error.seen
    nothing, names = np.zeros(len(mesh), bool), [view.name for view in views]
    return PartialCoverage(mesh, nothing, face_views, classify(face_views, settings), names, settings, metric, reason)


def _along_lumen(
    mesh: TriangleMesh, face_views: FaceViews, views: Sequence[CoverageView], settings: CoverageSettings
) -> WallCoverage:
    """Coverage of the section of a lumen that was seen, its wall completed by a guess."""
    line = find_centreline(mesh, [view.camera_to_world for view in views])
    guess = guessed_wall(wall_around(mesh, line))
    vertices = np.concatenate([mesh.vertices, guess.vertices.astype(mesh.vertices.dtype)])
    whole = TriangleMesh(vertices, np.concatenate([mesh.triangles, guess.triangles + len(mesh.vertices)]))
    guessed = np.arange(len(whole)) >= len(mesh)
    unseen = vars(FaceViews.unseen(len(guess)))
    whole_views = FaceViews(**{name: np.concatenate([seen, unseen[name]]) for name, seen in vars(face_views).items()})
    level = classify(whole_views, settings)
    arc, clock, _ = line.unroll(whole.centers)
    # Beyond the ends of the centreline nothing was guessed, so that the share of wall seen there says nothing.
    along = (arc >= line.arc[0]) & (arc <= line.arc[-1])
    section = find_section(arc[along], whole.areas[along], whole_views.seen[along])
    names = [view.name for view in views]
    wall = WallCoverage(
        whole, guessed, whole_views, level, names, settings, True, line, arc, clock, section, wall_around(whole, line)
    )
    missed = (level == Level.UNSEEN) & wall.inside
    touching = near_pairs(whole.centers, missed & guessed, missed & ~guessed, _TOUCHING)
    pairs = np.concatenate([neighbours(whole), touching])
    regions = large_regions(missed, pairs, whole.areas, settings.region_area)
    return replace(wall, regions=[_described(triangles, wall, views) for triangles in regions])


def _described(triangles: Int[np.ndarray, "K"], wall: WallCoverage, views: Sequence[CoverageView]) -> MissedRegion:
    areas, centers = wall.mesh.areas[triangles], wall.mesh.centers[triangles]
    area = float(areas.sum())
    centroid = (centers * areas[:, None]).sum(axis=0) / area
    # On the wall, not inside the lumen, where the centroid of a ring would be.
    middle = centers[np.argmin(np.linalg.norm(centers - centroid, axis=1))]
    position, clock, _ = wall.line.unroll(middle[None])
    start, end = float(wall.arc[triangles].min()), float(wall.arc[triangles].max())
    return MissedRegion(
        triangles,
        area,
        float(areas[wall.guessed[triangles]].sum()),
        middle,
        float(position[0]),
        float(clock[0]),
        (start, end),
        start < wall.section.start + STEP or end > wall.section.end - STEP,
        _nearest_view(centers[:: max(1, len(centers) // _SAMPLES)], views),
    )


def _nearest_view(points: Float[np.ndarray, "N 3"], views: Sequence[CoverageView]) -> int:
    """Index of the view that has most of the points in its image, whether hidden or not, for their distance."""
    merits = []
    for view in views:
        local = (points - view.center) @ view.camera_to_world[:3, :3]
        merits.append(view.lens.shows(local, view.mask).mean() / (_NEAR + np.linalg.norm(local, axis=1).mean()))
    return int(np.argmax(merits))


def neighbours(mesh: TriangleMesh) -> Int[np.ndarray, "E 2"]:
    """Pairs of triangles with a common edge; an edge of more than two joins them in a chain. [E, 2]"""
    corners = mesh.triangles.astype(np.int64)
    edges = np.sort(np.concatenate([corners[:, [0, 1]], corners[:, [1, 2]], corners[:, [2, 0]]]), axis=1)
    owners = np.tile(np.arange(len(corners)), 3)
    keys = edges[:, 0] * len(mesh.vertices) + edges[:, 1]
    order = np.argsort(keys, kind="stable")
    keys, owners = keys[order], owners[order]
    same = np.flatnonzero(keys[1:] == keys[:-1])
    return np.stack([owners[same], owners[same + 1]], axis=1)


def near_pairs(
    centers: Float[np.ndarray, "F 3"], first: Bool[np.ndarray, "F"], second: Bool[np.ndarray, "F"], within: float
) -> Int[np.ndarray, "E 2"]:
    """Pairs of triangles of two sets: the nearest, if their centroids are within a distance, mm. [E, 2]"""
    rows, columns = np.flatnonzero(first), np.flatnonzero(second)
    if not len(rows) or not len(columns):
        return np.zeros((0, 2), np.int64)
    distance, nearest = cKDTree(centers[columns]).query(centers[rows], distance_upper_bound=within)
    near = np.isfinite(distance)
    return np.stack([rows[near], columns[np.asarray(nearest)[near]]], axis=1)


def large_regions(
    chosen: Bool[np.ndarray, "F"], pairs: Int[np.ndarray, "E 2"], areas: Float[np.ndarray, "F"], smallest: float
) -> list[Int[np.ndarray, "K"]]:
    """Connected regions above an area, mm^2, the largest first, each as the indices of its triangles."""
    inside = np.flatnonzero(chosen)
    if not len(inside):
        return []
    first, second = pairs[chosen[pairs].all(axis=1)].T
    graph = coo_matrix((np.ones(len(first), np.int8), (first, second)), shape=(len(chosen), len(chosen)))
    _, labels = connected_components(graph, directed=False)
    area = np.bincount(labels[inside], areas[inside])
    large = np.flatnonzero(area > smallest)
    large = large[np.argsort(-area[large], kind="stable")]
    return [inside[labels[inside] == number] for number in large]
