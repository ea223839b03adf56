"""Dense depth of a posed video: the passes over its frames."""

from __future__ import annotations

import logging
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float32

from coliags_plugin.core.errors import InputError
from coliags_plugin.core.progress import Progress
from coliags_plugin.core.scenes import Frame
from coliags_plugin.datamanagers.reading.parallel import parallel_map
from coliags_plugin.reconstruction.depth.completion import complete
from coliags_plugin.reconstruction.depth.confidence import fused_confidence, known_weight, sweep_weight
from coliags_plugin.reconstruction.depth.depth_range import DepthRange
from coliags_plugin.reconstruction.depth.fusion import DepthMap, fuse_frame
from coliags_plugin.reconstruction.depth.neighbours import choose_neighbours
from coliags_plugin.reconstruction.depth.priors import DepthPrior
from coliags_plugin.reconstruction.depth.settings import DepthSettings, SweepSettings
from coliags_plugin.reconstruction.depth.sweeping import Swept, ratios, sweep_frame
from coliags_plugin.reconstruction.depth.views import Guide, guide_of, resized_map
from coliags_plugin.reconstruction.depth.work_files import Arrays, Recent, WorkFolder

log = logging.getLogger(__name__)

#: Fewest neighbours that a frame's depth is trusted with, and fewest frames that can have as many.
FEWEST_NEIGHBOURS = 3
FEWEST_FRAMES = FEWEST_NEIGHBOURS + 1
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
        check_motion(frames)
        self.frames, self.prior, self.range, self.settings = frames, prior, depth_range, settings
        self.work, self.jobs, self.progress = work, jobs, progress
        self.last = ""
        self.medians: Sequence[float] = depth_range.medians

    def run(self) -> None:
        """Run all passes that are not done.

        Raises:
            InputError: No frame has enough neighbours.
        """
        for number, sweep in enumerate(self.settings.sweeps):
            neighbours = self._neighbours(f"neighbours-{number}", self.medians)
            base = self.last or None
            self._sweep(f"swept-{number}", sweep, neighbours, base, f"sweep {number + 1}")
            fusions = self.settings.fusions if number == len(self.settings.sweeps) - 1 else 1
            for again in range(fusions):
                self._fuse(f"fused-{number}-{again}", sweep, neighbours, again > 0)
            self.medians = self.work.value(f"medians-{number}", lambda: self._medians(self.last))

    def result(self, index: int) -> Estimate:
        """The estimate of a frame, after :meth:`run`."""
        found = self.work.load(self.last, index)
        return Estimate(found["depth"], found["confidence"])

    def _neighbours(self, name: str, medians: Sequence[float]) -> list[list[int]]:
        centers = np.stack([frame.camera.center.cpu().double().numpy() for frame in self.frames])
        axes = np.stack([frame.camera.optical_axis.cpu().double().numpy() for frame in self.frames])
        found: list[list[int]] = self.work.value(name, lambda: choose_neighbours(centers, axes, medians, self.settings))
        lonely = sum(len(others) < FEWEST_NEIGHBOURS for others in found)
        if lonely == len(found):
            span = float(np.linalg.norm(np.ptp(centers, axis=0)))
            raise InputError(
                f"no frame has {FEWEST_NEIGHBOURS} others at a distance of {100 * min(self.settings.baselines):g} % "
                f"of the depth or more: the path spans {span:.3g}, the median depth is {np.median(medians):.3g}",
                "a camera that moves: rotation alone gives no depth",
                "Use a longer stretch, check the poses, or lower depth.baselines",
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
        guides: Recent[Guide] = Recent(
            lambda index: guide_of(self.frames[index].to("cpu"), sweep.reduction, self.settings.features), _HELD
        )
        factors = ratios(sweep, (self.range.near, self.range.far))

        def swept(index: int) -> Arrays:
            guide = guides(index)
            height, width = guide.intensity.shape
            if base is None:
                surface = np.full((height, width), self.range.near, np.float32)
            else:
                surface = resized_map(self.work.load(base, index)["depth"], (width, height))
            others = [guides(other) for other in neighbours[index]]
            if len(others) < FEWEST_NEIGHBOURS:
                nothing = np.zeros((height, width), np.float32)
                return vars(Swept(surface, nothing, nothing))
            return vars(sweep_frame(guide, others, surface, factors, sweep, self.settings))

        self._stage(stage, swept, title)

    def _fuse(
        self,
        stage: str,
        sweep: SweepSettings,
        neighbours: Sequence[Sequence[int]],
        again: bool,
    ) -> None:
        before = self.last
        guides: Recent[Guide] = Recent(
            lambda index: guide_of(self.frames[index].to("cpu"), sweep.reduction, self.settings.features), 4
        )

        def depth_map(index: int) -> tuple[DepthMap, np.ndarray]:
            found, pose = self.work.load(before, index), guides(index).pose
            if again:
                return DepthMap(pose, found["known"], found["confidence"]), found["match"]
            swept = Swept(found["depth"], found["match"], found["margin"])
            return DepthMap(pose, swept.depth, sweep_weight(swept)), swept.match

        maps: Recent[tuple[DepthMap, np.ndarray]] = Recent(depth_map, _HELD)

        def fused(index: int) -> Arrays:
            (own, match), guide = maps(index), guides(index)
            found = fuse_frame(own, [maps(other)[0] for other in neighbours[index]], self.settings.agreement)
            confidence = fused_confidence(found, match)
            confidence[(found.votes <= 0.0) | ~guide.usable] = 0.0
            weight = known_weight(confidence)
            known = np.log(found.depth)
            frame = self.frames[index].to("cpu")
            size = (guide.intensity.shape[1], guide.intensity.shape[0])
            prior = self.prior.log_depth(frame, size, guide.usable, known, weight, self.medians[index])
            low, high = np.log(self.range.near), np.log(self.range.far)
            depth = np.exp(complete(known, weight, np.clip(prior, low, high), guide.intensity))
            return {
                "depth": np.clip(depth, self.range.near, self.range.far).astype(np.float32),
                "confidence": confidence,
                "known": found.depth,
                "match": match,
                "votes": found.votes,
                "against": found.against,
                "spread": found.spread,
            }

        self._stage(stage, fused, stage.replace("fused-", "fuse "))

    def _stage(self, stage: str, function: Callable[[int], Arrays], title: str) -> None:
        def one(index: int) -> None:
            if not self.work.has(stage, index):
                self.work.save(stage, index, function(index))

        if not self.work.is_done(stage):
            parallel_map(one, range(len(self.frames)), title, self.progress, self.jobs)
            self.work.finish(stage, None)
        self.last = stage

    def _medians(self, stage: str) -> list[float]:
        return [float(np.median(self.work.load(stage, index)["depth"])) for index in range(len(self.frames))]


def check_motion(frames: Sequence[Frame]) -> None:
    """Check that a video can give depth at all.

    Raises:
        InputError: It has too few frames, or all cameras are at one position.
    """
    if len(frames) < FEWEST_FRAMES:
        raise InputError(
            f"{len(frames)} frames", f"at least {FEWEST_FRAMES}, from different positions", "Give more of the video"
        )
    centers = np.stack([frame.camera.center.cpu().double().numpy() for frame in frames])
    if not np.ptp(centers, axis=0).max() > 0.0:
        raise InputError(
            f"all {len(frames)} cameras are at the same position",
            "poses at different positions",
            "A camera that does not move, or only turns, gives no depth; check the poses",
        )
