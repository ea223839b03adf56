"""Poses of a video from its pictures and depth (docs/poses.md 11)."""

from __future__ import annotations

import logging
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from jaxtyping import Bool, Float

from coliags_plugin.core.errors import InputError
from coliags_plugin.core.intrinsics import Intrinsics
from coliags_plugin.core.progress import Progress
from coliags_plugin.poses.rigid import inverse
from coliags_plugin.reconstruction.odometry.chain import Chain, chain, filled
from coliags_plugin.reconstruction.odometry.features import motion_by_features
from coliags_plugin.reconstruction.odometry.frames import PreparedVideo, RgbdFrame, typical_depth
from coliags_plugin.reconstruction.odometry.libraries import exact_open3d
from coliags_plugin.reconstruction.odometry.pose_graph import further_pairs, optimise, revisited_pairs
from coliags_plugin.reconstruction.odometry.registration import Edge, Registrar, Term
from coliags_plugin.reconstruction.odometry.settings import TrackingSettings

log = logging.getLogger(__name__)

#: Pairs that tell whether depth is exact, and how large its residual may be then: 0.14 % of the median depth, squared.
#: Exact depth has 4e-7 and noise of 0.1 % 1.4e-6; depth in 8 bits has 9e-6.
_PROBES, _EXACT = 6, 2e-6
#: By how much less brightness may correlate under point-to-plane than under hybrid.
_AS_GOOD = 0.02
#: Revisits: frames in between, distance in median depths, degrees, and for every so-many-th frame.
_APART, _NEAR, _TURNED, _EVERY = 20, 0.3, 20.0, 4
#: Prepared frames in memory beyond those that edges span.
_SPARE = 4


@dataclass(frozen=True, eq=False)
class Tracking:
    """What came out.

    Attributes:
        camera_to_world: OpenCV axes; world: the first camera; unit of the depth. [N, 4, 4]
        tracked: False where a pose is only a guess at constant velocity. [N]
        term: What frames were laid together by.
        edges: Between neighbours, lengths in units of the depth.
        further: Over several frames and revisits, the dropped ones left out.
        dropped: Edges that the optimised path contradicts.
        refused: Further pairs that could not be laid together.
        failed: Neighbouring frames (i, i + 1) that could not be laid together.
        jumps: Pairs of frames across which no edge reaches: what lies behind may be anywhere.
    """

    camera_to_world: Float[np.ndarray, "N 4 4"]
    tracked: Bool[np.ndarray, "N"]
    term: Term
    edges: tuple[Edge, ...]
    further: tuple[Edge, ...]
    dropped: tuple[Edge, ...]
    refused: int
    failed: tuple[tuple[int, int], ...]
    jumps: tuple[tuple[int, int], ...]

    @property
    def fitness(self) -> float:
        """Mean over edges between neighbours."""
        return float(np.mean([edge.fitness for edge in self.edges]))

    @property
    def depth_rmse(self) -> float:
        """Mean over edges between neighbours, unit of the depth."""
        return float(np.mean([edge.depth_rmse for edge in self.edges]))

    @property
    def correlation(self) -> float:
        """Mean over edges between neighbours."""
        return float(np.mean([edge.correlation for edge in self.edges]))


def track(
    video: Sequence[RgbdFrame],
    intrinsics: Intrinsics,
    settings: TrackingSettings,
    progress: Progress | None = None,
) -> Tracking:
    """Find the poses of a video.

    Args:
        video: Frames, in order; read as they are needed.
        intrinsics: The pinhole of all of them.
        settings: Options.
        progress: Told how far it is.

    Raises:
        InputError: There are fewer than two frames; their sizes differ; no depth is known; no two frames can be laid
            together; or open3d is missing.
    """
    if len(video) < 2:
        raise InputError(f"{len(video)} frame" + "s" * (len(video) != 1), "two or more frames: odometry finds motions")
    _check_sizes(video, intrinsics)
    unit = typical_depth(video)
    with exact_open3d() as open3d:
        frames = PreparedVideo(video, unit, max((*settings.skips, 1)) + _SPARE, settings.enlarge)
        enlarged = intrinsics.resized(intrinsics.width * settings.enlarge, intrinsics.height * settings.enlarge)
        work = _Work(open3d, frames, enlarged, settings)
        wanted = settings.method
        term: Term = work.choose_term(len(video)) if wanted == "auto" else wanted
        work.use(term)
        path = chain(len(video), work.believed, settings.max_gap, progress)
        if not path.edges:
            raise InputError(
                f"no two neighbours among {len(video)} frames could be laid together",
                f"frames that share {settings.min_fitness:.0%} of their surface and look alike there (correlation "
                f"{settings.min_correlation:g})",
                "Check that pictures, depth and intrinsics belong together (coliags data check); use every frame of "
                "the video; or lower --set tracking.min_correlation for pictures with much noise",
            )
        result = work.corrected(path, progress) if settings.pose_graph else Correction(path.camera_to_world)
    poses = filled(path.placed, result.camera_to_world, len(video))
    poses[:, :3, 3] *= unit
    return Tracking(
        camera_to_world=poses,
        tracked=_tracked(path, len(video)),
        term=term,
        edges=_in_units(path.edges, unit),
        further=_in_units(result.further, unit),
        dropped=_in_units(result.dropped, unit),
        refused=result.refused,
        failed=path.failed,
        jumps=tuple(
            (bridge.target, bridge.source)
            for bridge in path.bridges
            if not any(edge.target <= bridge.target and bridge.source <= edge.source for edge in result.further)
        ),
    )


@dataclass(frozen=True, eq=False)
class Correction:
    """A path, perhaps corrected; lengths in the video's own unit.

    Attributes:
        camera_to_world: Of the placed frames. [P, 4, 4]
        further, dropped, refused: See :class:`Tracking`.
    """

    camera_to_world: Float[np.ndarray, "P 4 4"]
    further: tuple[Edge, ...] = ()
    dropped: tuple[Edge, ...] = ()
    refused: int = 0


class _Work:
    """One video being tracked."""

    def __init__(self, open3d: Any, frames: PreparedVideo, intrinsics: Intrinsics, settings: TrackingSettings) -> None:
        self._open3d, self._frames, self._intrinsics, self._settings = open3d, frames, intrinsics, settings
        self.use("hybrid")

    def use(self, term: Term) -> None:
        """Lay frames together by this from now on."""
        self._registrar = Registrar(self._open3d, self._intrinsics, term)

    def believed(self, source: int, target: int, guess: Float[np.ndarray, "4 4"]) -> Edge | None:
        """An edge that depth and brightness bear out; None where there is none.

        Where the guess leads nowhere, features give another: descent goes astray beyond some ten pixels.
        """
        frames = self._frames[source], self._frames[target]
        edge = self._registrar.register((source, target), *frames, guess)
        if self._bears_out(edge):
            return edge
        by_features = motion_by_features(*frames, self._intrinsics)
        if by_features is None:
            return None
        edge = self._registrar.register((source, target), *frames, by_features)
        return edge if self._bears_out(edge) else None

    def _bears_out(self, edge: Edge | None) -> bool:
        return (
            edge is not None
            and edge.fitness >= self._settings.min_fitness
            and edge.correlation >= self._settings.min_correlation
        )

    def choose_term(self, count: int) -> Term:
        """Point-to-plane where it lies within what exact depth leaves and its motions look as right as hybrid's.

        The second half matters: on a plane, or in a smooth tube, exact depth leaves no residual at all for motions
        that are wrong.
        """
        found: dict[Term, list[Edge | None]] = {}
        probes = np.unique(np.linspace(1, count - 1, min(_PROBES, count - 1)).round().astype(int))
        for term in ("point-to-plane", "hybrid"):
            self.use(term)
            found[term] = [self.believed(int(frame), int(frame) - 1, np.eye(4)) for frame in probes]
        planes = [edge for edge in found["point-to-plane"] if edge is not None]
        hybrids = [edge for edge in found["hybrid"] if edge is not None]
        if not planes or len(planes) < len(hybrids):
            return "hybrid"
        residual = float(np.median([edge.residual for edge in planes]))
        looks = float(np.median([edge.correlation for edge in planes]))
        wanted = float(np.median([edge.correlation for edge in hybrids])) - _AS_GOOD if hybrids else 0.0
        chosen: Term = "point-to-plane" if residual < _EXACT and looks >= wanted else "hybrid"
        log.info(
            "%d pairs laid together by depth alone: residual %.2g of the median depth, correlation of brightness %.3f; "
            "tracked by %s",
            len(planes),
            residual**0.5,
            looks,
            chosen,
        )
        return chosen

    def corrected(self, path: Chain, progress: Progress | None) -> Correction:
        """The path after edges over several frames, then after revisits, which only a good path shows."""
        settings = self._settings
        certain = [(edge, self._information(edge)) for edge in path.edges]
        uncertain: list[tuple[Edge, np.ndarray]] = []
        poses, refused = path.camera_to_world, 0
        dropped: tuple[Edge, ...] = ()
        neighbours = {(edge.source, edge.target) for edge in path.edges}
        rounds = ["skips", "revisits"] if settings.revisits else ["skips"]
        for kind in rounds:
            if kind == "skips":
                pairs = further_pairs(path.placed, settings.skips)
            else:
                pairs = revisited_pairs(path.placed, poses, _APART, _NEAR, _TURNED, _EVERY)
            place = dict(zip(path.placed, poses, strict=True))
            wanted = [pair for pair in pairs if pair not in neighbours]
            edges = []
            for done, (source, target) in enumerate(wanted, start=1):
                guess = inverse(place[target][None])[0] @ place[source]
                edge = self.believed(source, target, guess)
                if edge is not None:
                    edges.append((edge, self._information(edge)))
                if progress is not None:
                    progress(f"pose graph, {kind}", done, len(wanted))
            refused += len(wanted) - len(edges)
            if not edges:
                continue
            uncertain += edges
            poses, dropped = optimise(
                self._open3d, path.placed, poses, certain, uncertain, path.bridges, settings.prune
            )
        left = tuple(edge for edge, _ in uncertain if edge not in dropped)
        return Correction(poses, left, dropped, refused)

    def _information(self, edge: Edge) -> Float[np.ndarray, "6 6"]:
        return self._registrar.information(edge, self._frames[edge.source], self._frames[edge.target])


def _check_sizes(video: Sequence[RgbdFrame], intrinsics: Intrinsics) -> None:
    width, height = intrinsics.width, intrinsics.height
    for index in range(len(video)):
        frame = video[index]
        for what, shape in (("picture", frame.image.shape), ("depth", frame.depth.shape)):
            if shape[:2] != (height, width):
                raise InputError(
                    f"frame {index} ({frame.name}): a {what} of {shape[1]} x {shape[0]}",
                    f"{width} x {height}, as the intrinsics and the other frames",
                    "Bring all to one size",
                )


def _tracked(path: Chain, count: int) -> Bool[np.ndarray, "N"]:
    """Frames that an edge holds."""
    tracked = np.zeros(count, bool)
    for edge in path.edges:
        tracked[[edge.source, edge.target]] = True
    return tracked


def _in_units(edges: Iterable[Edge], unit: float) -> tuple[Edge, ...]:
    """Edges with lengths in units of the depth."""
    result = []
    for edge in edges:
        motion = edge.source_to_target.copy()
        motion[:3, 3] *= unit
        result.append(replace(edge, source_to_target=motion, depth_rmse=edge.depth_rmse * unit))
    return tuple(result)
