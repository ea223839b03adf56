"""Camera tracking of a video by RGB-D odometry and pose-graph optimisation (docs/poses.md 11)."""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from jaxtyping import Bool, Float

from coliags_plugin.core.errors import InputError
from coliags_plugin.core.intrinsics import Intrinsics
from coliags_plugin.core.progress import Progress, with_progress
from coliags_plugin.geometry.poses.rigid import inverse
from coliags_plugin.reconstruction.libraries import deterministic_open3d
from coliags_plugin.reconstruction.odometry.chain import Chain, chain, fill_gaps
from coliags_plugin.reconstruction.odometry.frames import PreparedFrame, RgbdFrame, prepared_frames, typical_depth
from coliags_plugin.reconstruction.odometry.pose_graph import optimise, revisit_pairs, skip_pairs
from coliags_plugin.reconstruction.odometry.registration import Edge, FrameRegistration, Term, motion_by_features
from coliags_plugin.reconstruction.odometry.settings import TrackingSettings

log = logging.getLogger(__name__)

#: Number of test pairs for method auto, and the largest squared residual of exact depth: 0.14 % of the median depth,
#: squared. Exact depth has 4e-7 and noise of 0.1 % 1.4e-6; depth in 8 bits has 9e-6.
_PROBES, _EXACT = 6, 2e-6
#: Largest loss of brightness correlation of point-to-plane against hybrid.
_CORRELATION_MARGIN = 0.02
#: Loop closures: least frames in between, largest distance in median depths, largest angle in degrees, frame stride.
_APART, _NEAR, _TURNED, _EVERY = 20, 0.3, 20.0, 4
#: Prepared frames in memory beyond those that edges span.
_SPARE = 4


@dataclass(frozen=True, eq=False)
class Tracking:
    """Result of tracking."""

    camera_to_world: Float[np.ndarray, "N 4 4"]  # OpenCV axes; world: the first camera; unit of the depth
    tracked: Bool[np.ndarray, "N"]  # whether an edge reaches a frame; False: its pose is a guess at constant velocity
    term: Term  # residual used for registration
    edges: tuple[Edge, ...]  # odometry edges, lengths in units of the depth
    further: tuple[Edge, ...]  # edges over several frames and loop closures, without the dropped ones
    dropped: tuple[Edge, ...]  # edges that the optimisation rejected as outliers
    refused: int  # number of further pairs that could not be registered
    failed: tuple[tuple[int, int], ...]  # consecutive frames (i, i + 1) that could not be registered
    jumps: tuple[tuple[int, int], ...]  # frames that no edge spans: the relative pose of the segments is a guess

    @property
    def fitness(self) -> float:
        """Mean fitness of the odometry edges."""
        return float(np.mean([edge.fitness for edge in self.edges]))

    @property
    def depth_rmse(self) -> float:
        """Mean depth RMSE of the odometry edges, unit of the depth."""
        return float(np.mean([edge.depth_rmse for edge in self.edges]))

    @property
    def correlation(self) -> float:
        """Mean intensity correlation of the odometry edges."""
        return float(np.mean([edge.correlation for edge in self.edges]))


def track(
    video: Sequence[RgbdFrame], intrinsics: Intrinsics, settings: TrackingSettings, progress: Progress | None = None
) -> Tracking:
    """Estimate the poses of a video, read lazily, whose frames share a pinhole."""
    if len(video) < 2:
        raise InputError(f"{len(video)} frame" + "s" * (len(video) != 1), "two or more frames")
    _check_sizes(video, intrinsics)
    unit = typical_depth(video)
    with deterministic_open3d() as open3d:
        frames = prepared_frames(video, unit, max((*settings.skips, 1)) + _SPARE, settings.enlarge)
        enlarged = intrinsics.resized(intrinsics.width * settings.enlarge, intrinsics.height * settings.enlarge)
        tracker = _Tracker(open3d, frames, enlarged, settings)
        wanted = settings.method
        term: Term = tracker.choose_term(len(video)) if wanted == "auto" else wanted
        tracker.use(term)
        path = chain(len(video), tracker.verified_edge, settings.max_gap, progress)
        if not path.edges:
            raise InputError(
                f"no two consecutive frames of {len(video)} could be registered",
                f"frames that share {settings.min_fitness:.0%} of their surface with similar texture (correlation "
                f"{settings.min_correlation:g})",
                "Check that images, depth and intrinsics match (coliags data check); use every frame of the video; "
                "or lower --set tracking.min_correlation for noisy images",
            )
        uncorrected: Correction = path.camera_to_world, (), (), 0
        corrected = tracker.corrected(path, progress) if settings.pose_graph else uncorrected
    posed, further, dropped, refused = corrected
    poses = fill_gaps(path.posed, posed, len(video))
    poses[:, :3, 3] *= unit
    return Tracking(
        camera_to_world=poses,
        tracked=np.isin(np.arange(len(video)), [(edge.source, edge.target) for edge in path.edges]),
        term=term,
        edges=_in_units(path.edges, unit),
        further=_in_units(further, unit),
        dropped=_in_units(dropped, unit),
        refused=refused,
        failed=path.failed,
        jumps=tuple(
            (bridge.target, bridge.source)
            for bridge in path.bridges
            if not any(edge.target <= bridge.target and bridge.source <= edge.source for edge in further)
        ),
    )


#: Poses of the posed frames; further edges, dropped edges and number of refused pairs of :class:`Tracking`.
Correction = tuple[Float[np.ndarray, "P 4 4"], tuple[Edge, ...], tuple[Edge, ...], int]


class _Tracker:
    """Registration, verification and pose-graph correction of one video."""

    def __init__(
        self, open3d: Any, frames: Callable[[int], PreparedFrame], intrinsics: Intrinsics, settings: TrackingSettings
    ) -> None:
        self._open3d, self._frames, self._intrinsics, self._settings = open3d, frames, intrinsics, settings
        self.use("hybrid")

    def use(self, term: Term) -> None:
        """Set the residual to minimise."""
        self._registration = FrameRegistration(self._open3d, self._intrinsics, term)

    def verified_edge(self, source: int, target: int, guess: Float[np.ndarray, "4 4"]) -> Edge | None:
        """Register two frames and verify the edge by depth and brightness; None if that fails.

        If registration from the given guess fails, it is repeated from a feature-based one: direct alignment converges
        only for motions up to about ten pixels.
        """
        frames = self._frames(source), self._frames(target)
        edge = self._registration.register((source, target), *frames, guess)
        if self._is_valid(edge):
            return edge
        by_features = motion_by_features(*frames, self._intrinsics)
        if by_features is None:
            return None
        edge = self._registration.register((source, target), *frames, by_features)
        return edge if self._is_valid(edge) else None

    def _is_valid(self, edge: Edge | None) -> bool:
        return (
            edge is not None
            and edge.fitness >= self._settings.min_fitness
            and edge.correlation >= self._settings.min_correlation
        )

    def choose_term(self, count: int) -> Term:
        """Point-to-plane if its residuals are those of exact depth and its brightness correlation matches hybrid's.

        The second condition is needed because on a plane or in a smooth tube exact depth leaves no residual for motions
        along the surface.
        """
        probes = np.unique(np.linspace(1, count - 1, min(_PROBES, count - 1)).round().astype(int)).tolist()

        def probed(term: Term) -> list[Edge]:
            self.use(term)
            edges = (self.verified_edge(frame, frame - 1, np.eye(4)) for frame in probes)
            return [edge for edge in edges if edge is not None]

        planes, hybrids = probed("point-to-plane"), probed("hybrid")
        if not planes or len(planes) < len(hybrids):
            return "hybrid"
        residual = float(np.median([edge.residual for edge in planes]))
        correlation = float(np.median([edge.correlation for edge in planes]))
        required = float(np.median([edge.correlation for edge in hybrids])) - _CORRELATION_MARGIN if hybrids else 0.0
        chosen: Term = "point-to-plane" if residual < _EXACT and correlation >= required else "hybrid"
        log.info(
            "%d test pairs registered by depth alone: residual %.2g of the median depth, correlation of brightness "
            "%.3f; tracking by %s",
            len(planes),
            residual**0.5,
            correlation,
            chosen,
        )
        return chosen

    def corrected(self, path: Chain, progress: Progress | None) -> Correction:
        """Optimise with edges over several frames, then with loop closures found from the optimised trajectory."""
        settings = self._settings
        certain = [(edge, self._information(edge)) for edge in path.edges]
        uncertain: list[tuple[Edge, np.ndarray]] = []
        poses, refused = path.camera_to_world, 0
        dropped: tuple[Edge, ...] = ()
        neighbours = {(edge.source, edge.target) for edge in path.edges}
        rounds = ["skips", "revisits"] if settings.revisits else ["skips"]
        for kind in rounds:
            if kind == "skips":
                pairs = skip_pairs(path.posed, settings.skips)
            else:
                pairs = revisit_pairs(path.posed, poses, _APART, _NEAR, _TURNED, _EVERY)
            pose_of = dict(zip(path.posed, poses, strict=True))
            wanted = [pair for pair in pairs if pair not in neighbours]
            edges = []
            for source, target in with_progress(wanted, f"pose graph, {kind}", progress):
                guess = inverse(pose_of[target][None])[0] @ pose_of[source]
                edge = self.verified_edge(source, target, guess)
                if edge is not None:
                    edges.append((edge, self._information(edge)))
            refused += len(wanted) - len(edges)
            if not edges:
                continue
            uncertain += edges
            poses, dropped = optimise(self._open3d, path.posed, poses, certain, uncertain, path.bridges, settings.prune)
        kept = tuple(edge for edge, _ in uncertain if edge not in dropped)
        return poses, kept, dropped, refused

    def _information(self, edge: Edge) -> Float[np.ndarray, "6 6"]:
        return self._registration.information(edge, self._frames(edge.source), self._frames(edge.target))


def _check_sizes(video: Sequence[RgbdFrame], intrinsics: Intrinsics) -> None:
    width, height = intrinsics.width, intrinsics.height
    for index in range(len(video)):
        frame = video[index]
        for what, shape in (("image", frame.image.shape), ("depth", frame.depth.shape)):
            if shape[:2] != (height, width):
                raise InputError(
                    f"frame {index} ({frame.name}): {what} of {shape[1]} x {shape[0]}",
                    f"{width} x {height}, as the intrinsics and the other frames",
                    "Resize all to one size",
                )


def _in_units(edges: Iterable[Edge], unit: float) -> tuple[Edge, ...]:
    """Edges with lengths in units of the depth."""
    result = []
    for edge in edges:
        motion = edge.source_to_target.copy()
        motion[:3, 3] *= unit
        result.append(replace(edge, source_to_target=motion, depth_rmse=edge.depth_rmse * unit))
    return tuple(result)
