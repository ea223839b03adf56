"""Dense depth of a posed video: the passes over its frames."""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float32

from coliags_plugin.core.errors import InputError
from coliags_plugin.core.progress import Progress
from coliags_plugin.core.scenes import Frame
from coliags_plugin.datamanagers.reading.parallel import parallel_map
from coliags_plugin.reconstruction.depth.completion import (
    complete,
    data_weight,
    first_belief,
    near_rim,
    smooth_surface,
)
from coliags_plugin.reconstruction.depth.confidence import depth_confidence, sweep_weight
from coliags_plugin.reconstruction.depth.depth_range import DepthRange
from coliags_plugin.reconstruction.depth.fusion import DepthMap, fuse_frame
from coliags_plugin.reconstruction.depth.neighbours import choose_neighbours
from coliags_plugin.reconstruction.depth.priors import DepthPrior
from coliags_plugin.reconstruction.depth.settings import DepthSettings, SweepSettings
from coliags_plugin.reconstruction.depth.sweeping import Swept, ratios, sweep_frame
from coliags_plugin.reconstruction.depth.views import Guide, guide_of
from coliags_plugin.reconstruction.depth.work_files import Arrays, Recent, WorkFolder

log = logging.getLogger(__name__)

#: Fewest neighbours that a frame's depth is trusted with, and fewest frames that can have as many.
FEWEST_NEIGHBOURS = 3
FEWEST_FRAMES = FEWEST_NEIGHBOURS + 1
#: Mean weight of a frame's own matches below which it shows nothing that others do: blur, darkness, a touched wall.
LEAST_MATCHED = 0.1
#: Frames and depth maps held in memory.
_HELD = 40


@dataclass(frozen=True, eq=False)
class Estimate:
    """Estimated depth of a frame.

    Attributes:
        depth: z-depth at every pixel, scene units. [H, W]
        confidence: Estimated probability that it is off by less than 5 %; 0 where a prior alone speaks. [H, W]
    """

    depth: Float32[np.ndarray, "H W"]
    confidence: Float32[np.ndarray, "H W"]


class Estimation:
    """Estimation of the depth of a video, resumable at every frame of every pass.

    Args:
        frames: All frames in video order; pinhole cameras.
        prior: Gives depth where matching gives none.
        depth_range: Of the video.
        settings: Options.
        work: Where the results of the passes are kept.
        jobs: Number of threads.
        progress: Progress callback.

    Raises:
        InputError: There are too few frames, or the camera does not move.
    """

    def __init__(
        self,
        frames: Sequence[Frame],
        prior: DepthPrior,
        depth_range: DepthRange,
        settings: DepthSettings,
        work: WorkFolder,
        jobs: int = 1,
        progress: Progress | None = None,
    ) -> None:
        check_video(frames)
        self.frames, self.prior, self.range, self.settings = frames, prior, depth_range, settings
        self.work, self.jobs, self.progress = work, jobs, progress
        self.last = ""
        self.medians: Sequence[float] = depth_range.medians

    def run(self) -> None:
        """Run all passes that are not done.

        Raises:
            InputError: No frame has enough neighbours.
        """
        with _one_thread_of_opencv():
            for number, sweep in enumerate(self.settings.sweeps):
                self._pass(number, sweep)

    def result(self, index: int) -> Estimate:
        """The estimate of a frame, after :meth:`run`."""
        found = self.work.load(self.last, index)
        return Estimate(found["depth"], found["confidence"])

    def _pass(self, number: int, sweep: SweepSettings) -> None:
        neighbours = self._neighbours(f"neighbours-{number}", sweep, self.medians)
        base = self.last or None
        self._sweep(f"swept-{number}", sweep, neighbours, base, f"sweep {number + 1}")
        self._fuse(f"fused-{number}", sweep, neighbours, f"fuse {number + 1}")
        self.medians = self.work.value(f"medians-{number}", lambda: self._medians(self.last))

    def _neighbours(self, name: str, sweep: SweepSettings, medians: Sequence[float]) -> list[list[int]]:
        centers = np.stack([frame.camera.center.cpu().double().numpy() for frame in self.frames])
        axes = np.stack([frame.camera.optical_axis.cpu().double().numpy() for frame in self.frames])
        found: list[list[int]] = self.work.value(
            name, lambda: choose_neighbours(centers, axes, medians, sweep.baselines, self.settings)
        )
        lonely = sum(len(others) < FEWEST_NEIGHBOURS for others in found)
        if lonely == len(found):
            span = float(np.linalg.norm(np.ptp(centers, axis=0)))
            raise InputError(
                f"no frame has {FEWEST_NEIGHBOURS} others at a distance of {100 * min(sweep.baselines):g} % "
                f"of the depth or more: the path spans {span:.3g}, the median depth is {np.median(medians):.3g}",
                "a camera that moves: rotation alone gives no depth",
                "Use a longer stretch, check the poses, or lower the baselines of depth.sweeps",
            )
        if lonely:
            log.warning(
                "%d of %d frames have fewer than %d neighbours: their depth has confidence 0",
                lonely,
                len(found),
                FEWEST_NEIGHBOURS,
            )
        return found

    def _sweep(
        self, stage: str, sweep: SweepSettings, neighbours: Sequence[Sequence[int]], base: str | None, title: str
    ) -> None:
        guides = self._guides(sweep.reduction)
        factors = ratios(sweep, (self.range.near, self.range.far))

        def swept(index: int) -> Arrays:
            guide = guides(index)
            height, width = guide.intensity.shape
            if base is None or sweep.reach is None:
                surface = np.full((height, width), self.range.near, np.float32)
            else:
                surface = smooth_surface(self.work.load(base, index)["depth"], guide.intensity)
            others = [guides(other) for other in neighbours[index]]
            if len(others) < FEWEST_NEIGHBOURS:
                nothing = np.zeros((height, width), np.float32)
                return vars(Swept(surface, nothing, nothing))
            return vars(sweep_frame(guide, others, surface, factors, sweep, self.settings))

        self._stage(stage, swept, title)

    def _fuse(self, stage: str, sweep: SweepSettings, neighbours: Sequence[Sequence[int]], title: str) -> None:
        swept = self.last
        guides = self._guides(sweep.reduction)

        def depth_map(index: int) -> DepthMap:
            found = Swept(**self.work.load(swept, index))
            return DepthMap(guides(index).pose, found.depth, sweep_weight(found))

        maps: Recent[DepthMap] = Recent(depth_map, _HELD)
        low, high = np.log(self.range.near), np.log(self.range.far)

        def fused(index: int) -> Arrays:
            own, guide = maps(index), guides(index)
            found = fuse_frame(own, [maps(other) for other in neighbours[index]], self.settings.agreement)
            # Where this frame shows a highlight, others may see the surface.
            support = found.votes
            known = np.log(found.depth)
            prior = self.prior.log_depth(
                self.frames[index].to("cpu"), guide.usable, known, data_weight(support), self.medians[index]
            )
            rim = near_rim(known, 2 * sweep.radius)
            prior = np.clip(prior, low, high)
            # Later sweeps have a surface, and small windows: their edges are where they belong.
            whole = sweep.reach is None
            belief = first_belief(known, support, prior, rim) if whole else np.ones_like(support)
            log_depth = np.clip(complete(known, support, belief, prior, guide.intensity), low, high)
            confidence = depth_confidence(log_depth, support, found.spread, rim)
            if len(neighbours[index]) < FEWEST_NEIGHBOURS or own.weight.mean() < LEAST_MATCHED:
                confidence[:] = 0.0
            return {"depth": np.exp(log_depth), "confidence": confidence}

        self._stage(stage, fused, title)

    def _guides(self, reduction: int) -> Recent[Guide]:
        return Recent(lambda index: guide_of(self.frames[index].to("cpu"), reduction, self.settings.features), _HELD)

    def _stage(self, stage: str, function: Callable[[int], Arrays], title: str) -> None:
        def one(index: int) -> None:
            if not self.work.has(stage, index):
                self.work.save(stage, index, function(index))

        if not self.work.is_done(stage):
            parallel_map(one, range(len(self.frames)), title, self.progress, self.jobs)
            self.work.finish(stage, self.last or None)
        self.last = stage

    def _medians(self, stage: str) -> list[float]:
        return [float(np.median(self.work.load(stage, index)["depth"])) for index in range(len(self.frames))]


@contextmanager
def _one_thread_of_opencv() -> Iterator[None]:
    """Keep OpenCV to the calling thread: the last bits of its global smoother depend on how it splits an image."""
    import cv2

    before = cv2.getNumThreads()
    cv2.setNumThreads(1)
    try:
        yield
    finally:
        cv2.setNumThreads(before)


def check_video(frames: Sequence[Frame]) -> None:
    """Check that a video can give depth at all.

    Raises:
        InputError: It has too few frames, images of several sizes, or all cameras are at one position.
    """
    if len(frames) < FEWEST_FRAMES:
        raise InputError(
            f"{len(frames)} frames", f"at least {FEWEST_FRAMES}, from different positions", "Give more of the video"
        )
    sizes = sorted({(frame.camera.width, frame.camera.height) for frame in frames})
    if len(sizes) > 1:
        raise InputError(
            f"images of {' and '.join(f'{width} x {height}' for width, height in sizes[:3])} pixels",
            "images of one size",
            "Set width and height of the data manager, or estimate each camera's frames apart",
        )
    centers = np.stack([frame.camera.center.cpu().double().numpy() for frame in frames])
    if not np.ptp(centers, axis=0).max() > 0.0:
        raise InputError(
            f"all {len(frames)} cameras are at the same position",
            "poses at different positions",
            "A camera that does not move, or only turns, gives no depth; check the poses",
        )
