"""Dense depth of a posed video: the passes over its frames."""

from __future__ import annotations

import json
import logging
import math
import shutil
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from coliags_plugin.core.arrays import read_arrays
from coliags_plugin.core.depth_maps import Map, Pose, WeightedDepth
from coliags_plugin.core.errors import InputError
from coliags_plugin.core.files import atomic_write, make_folder, write_arrays, write_json
from coliags_plugin.core.images import sizes_text
from coliags_plugin.core.jobs import Progress, locked
from coliags_plugin.core.scene_files import parallel_map
from coliags_plugin.core.scenes import Frame
from coliags_plugin.reconstruction.depth.priors import (
    DepthRange,
    FilePrior,
    LightPrior,
    complete,
    data_weight,
    first_belief,
    near_rim,
    smooth_surface,
)
from coliags_plugin.reconstruction.depth.sweeping import (
    MAX_BASELINE,
    MAX_TURN,
    SWEEPS,
    DepthEstimationSettings,
    Guide,
    Sweep,
    Swept,
    depth_confidence,
    disagreement,
    fuse_frame,
    guide_of,
    ratios,
    sweep_frame,
    sweep_weight,
)

log = logging.getLogger(__name__)

Arrays = Mapping[str, np.ndarray]


@dataclass(frozen=True)
class WorkFolder:
    """The folder of an estimation's work files: one folder for each pass, one file in it for each frame."""

    path: Path

    def file(self, stage: str, index: int) -> Path:
        """The file of a frame of a pass."""
        return self.path / stage / f"{index:06d}.npz"

    def save(self, stage: str, index: int, arrays: Arrays) -> None:
        """Keep the results of a frame of a pass; atomic."""
        write_arrays(self.file(stage, index), arrays)

    def load(self, stage: str, index: int) -> dict[str, np.ndarray]:
        """The results of a frame of a pass."""
        return read_arrays(self.file(stage, index), "a work file of this estimation", optional=None)

    def value(self, name: str, make: Callable[[], Any]) -> Any:
        """A JSON value: the kept one, or else a new one, which is kept."""
        file = self.path / f"{name}.json"
        if not file.is_file():
            write_json(file, make())
        return json.loads(file.read_text())


@contextmanager
def work_folder(out: Path, request: Mapping[str, Any]) -> Iterator[WorkFolder]:
    """The work files for an output folder, beside it; removed when the block ends without an error.

    ``request`` is everything that determines the results, as JSON values; work files of another one are removed first.
    """
    path = out.parent / f".{out.name}.work"
    make_folder(path)
    with locked(path / "lock", out):
        file, described = path / "request.json", json.loads(json.dumps(dict(request)))
        stored = json.loads(file.read_text()) if file.is_file() else None
        if stored is not None and stored != described:
            log.warning("%s: work files of other data or options are removed", path)
        if stored != described:
            for old in path.iterdir():
                if old.is_dir():
                    shutil.rmtree(old)
                elif old.name != "lock":
                    old.unlink()
            write_json(file, described)
        else:
            log.info("resuming from the work files in %s", path)
        yield WorkFolder(path)
    shutil.rmtree(path, ignore_errors=True)


#: Fewest neighbours that a frame's depth is trusted with, and fewest frames that can have as many.
FEWEST_NEIGHBOURS = 3
FEWEST_FRAMES = FEWEST_NEIGHBOURS + 1
#: Mean weight of a frame's own matches, outside of masks and highlights, below which it shows nothing that others do:
#: blur, darkness, a touched wall.
LEAST_MATCHED = 0.1
#: Frames and depth maps held in memory: at least so many, and of small images as many as have so many pixels.
_HELD, _HELD_PIXELS = 40, 12_000_000


@dataclass
class Estimation:
    """Estimation of the depth of a video of pinhole cameras, resumable at every frame of every pass.

    A frame's depth is made of its own image and those of neighbours among ``sources``, indices of frames; that of the
    sources themselves depends on no other image.
    """

    frames: Sequence[Frame]
    sources: Sequence[int]
    prior: LightPrior | FilePrior
    range: DepthRange
    settings: DepthEstimationSettings
    work: WorkFolder
    jobs: int = 1
    progress: Progress | None = None
    last: str = ""  # name of the last pass

    def __post_init__(self) -> None:
        """Start from the medians of the depth range."""
        camera = self.frames[0].camera
        self.held = max(_HELD, _HELD_PIXELS // (camera.width * camera.height))
        self.medians: Sequence[float] = self.range.medians

    def run(self) -> None:
        """Run all passes that are not done."""
        import cv2

        # On one thread, as the last bits of OpenCV's global smoother depend on how it splits an image.
        threads = cv2.getNumThreads()
        cv2.setNumThreads(1)
        try:
            for number, sweep in enumerate(SWEEPS):
                neighbours = self._neighbours(number, sweep)
                self._sweep(number, sweep, neighbours)
                self._fuse(number, sweep, neighbours)
                self.medians = self.work.value(
                    f"medians-{number}",
                    lambda: [float(np.median(self.result(index)[0])) for index in range(len(self.frames))],
                )
            self._choose(neighbours)
        finally:
            cv2.setNumThreads(threads)

    def result(self, index: int) -> tuple[Map, Map, str]:
        """A frame's z-depth, scene units, and the probability that it is off by less than 5 %, 0 by a prior alone.

        Last, why that is 0 throughout; empty of other frames.
        """
        arrays = self.work.load(self.last, index)
        return arrays["depth"], arrays["confidence"], str(arrays["distrust"])

    def _neighbours(self, number: int, sweep: Sweep) -> list[list[int]]:
        centers = _camera_centers(self.frames)
        axes = np.stack([frame.camera.optical_axis.cpu().double().numpy() for frame in self.frames])
        neighbours: list[list[int]] = self.work.value(
            f"neighbours-{number}",
            lambda: choose_neighbours(centers, axes, self.sources, self.medians, sweep.baselines),
        )
        lonely = sum(len(others) < FEWEST_NEIGHBOURS for others in neighbours)
        if lonely == len(neighbours):
            span = float(np.linalg.norm(np.ptp(centers, axis=0)))
            raise InputError(
                f"no frame has {FEWEST_NEIGHBOURS} others at a distance of {100 * min(sweep.baselines):g} % "
                f"of the depth or more: the path spans {span:.3g}, the median depth is {np.median(self.medians):.3g}",
                "a camera that moves: rotation alone gives no depth",
                "Use a longer stretch, or check the poses",
            )
        return neighbours

    def _sweep(self, number: int, sweep: Sweep, neighbours: Sequence[Sequence[int]]) -> None:
        base, guides = f"fused-{number - 1}", self._guides(sweep.reduction)
        factors = ratios(sweep, (self.range.near, self.range.far))

        def swept(index: int) -> Arrays:
            guide = guides(index)
            if sweep.reach is None:
                surface = np.full_like(guide.intensity, self.range.near)
            else:
                surface = smooth_surface(self.work.load(base, index)["depth"], guide.intensity)
            others = [guides(other) for other in neighbours[index]]
            if len(others) < FEWEST_NEIGHBOURS:
                nothing = np.zeros_like(surface)
                return vars(Swept(surface, nothing, nothing))
            return vars(sweep_frame(guide, others, surface, factors, sweep))

        self._stage(f"swept-{number}", swept, f"sweep {number + 1}")

    def _fuse(self, number: int, sweep: Sweep, neighbours: Sequence[Sequence[int]]) -> None:
        swept, guides = self.last, self._guides(sweep.reduction)
        low, high = math.log(self.range.near), math.log(self.range.far)

        @lru_cache(maxsize=self.held)
        def depth_map(index: int) -> WeightedDepth:
            swept_frame = Swept(**self.work.load(swept, index))
            return WeightedDepth(guides(index).pose, swept_frame.depth, sweep_weight(swept_frame))

        def fused(index: int) -> Arrays:
            weighted, guide = depth_map(index), guides(index)
            others = [depth_map(other) for other in neighbours[index]]
            # Where this frame shows a highlight, others may see the surface.
            depth, support, spread = fuse_frame(weighted, others, self.settings.agreement)
            log_fused = np.log(depth)
            prior = self.prior.log_depth(
                self.frames[index].to("cpu"), guide.usable, log_fused, data_weight(support), self.medians[index]
            )
            rim = near_rim(log_fused, 2 * sweep.radius)
            prior = np.clip(prior, low, high)
            # Later sweeps have a surface, and small windows: their edges are where they belong.
            whole = sweep.reach is None
            belief = first_belief(log_fused, support, prior, rim) if whole else np.ones_like(support)
            log_depth = np.clip(complete(log_fused, support, belief, prior, guide.intensity), low, high)
            confidence = depth_confidence(log_depth, support, spread, rim)
            matched = float(weighted.weight[guide.usable].mean()) if guide.usable.any() else 0.0
            distrust = ""
            if len(neighbours[index]) < FEWEST_NEIGHBOURS:
                distrust = f"fewer than {FEWEST_NEIGHBOURS} other frames at a distance that gives depth"
            elif matched < LEAST_MATCHED:
                distrust = f"mean weight of their own matches below {LEAST_MATCHED:g}"
            if distrust:
                confidence[:] = 0.0
            return {"depth": np.exp(log_depth), "confidence": confidence, "distrust": np.array(distrust)}

        self._stage(f"fused-{number}", fused, f"fuse {number + 1}", spent=[swept])

    def _choose(self, neighbours: Sequence[Sequence[int]]) -> None:
        """Give each frame the depth, of its first sweep or of its last, that agrees better with its neighbours'.

        Small windows at full size see more, unless poses are wrong by about as much as these are wide.
        """
        import cv2

        first, last = (f"fused-{number}" for number in (0, len(SWEEPS) - 1))
        guides = self._guides(SWEEPS[-1].reduction)

        @lru_cache(maxsize=2 * self.held)
        def depth_map(stage: str, index: int) -> WeightedDepth:
            arrays = self.work.load(stage, index)
            depth = np.where(arrays["confidence"] > 0.0, arrays["depth"], np.float32(np.nan))
            pose = Pose.of(self.frames[index].camera, (depth.shape[1], depth.shape[0]))
            return WeightedDepth(pose, depth, np.ones_like(depth))

        def chosen(index: int) -> Arrays:
            arrays = self.work.load(last, index)
            of_first, of_last = (
                disagreement(depth_map(stage, index), [depth_map(stage, other) for other in neighbours[index]])
                for stage in (first, last)
            )
            if of_first < of_last < math.inf:
                guide, before = guides(index), self.work.load(first, index)
                size = guide.intensity.shape[::-1]
                arrays["depth"] = smooth_surface(before["depth"], guide.intensity)
                arrays["confidence"] = cv2.resize(before["confidence"], size, interpolation=cv2.INTER_LINEAR)
            return arrays

        self._stage("chosen", chosen, "choose", spent=[first, last])

    def _guides(self, reduction: int) -> Callable[[int], Guide]:
        """Frames prepared for matching, the last ones held."""

        @lru_cache(maxsize=self.held)
        def guide(index: int) -> Guide:
            return guide_of(self.frames[index].to("cpu"), reduction, self.settings.features)

        return guide

    def _stage(self, stage: str, function: Callable[[int], Arrays], title: str, spent: Sequence[str] = ()) -> None:
        def one(index: int) -> None:
            if not self.work.file(stage, index).is_file():
                self.work.save(stage, index, function(index))

        marker = self.work.path / f"{stage}.done"
        if not marker.is_file():
            parallel_map(one, range(len(self.frames)), title, self.progress, self.jobs)
            atomic_write(marker, "")
            for earlier in spent:
                shutil.rmtree(self.work.path / earlier, ignore_errors=True)
        self.last = stage


def check_video(frames: Sequence[Frame], sources: Sequence[int]) -> None:
    """Check that a video can give depth at all, from the frames of these indices."""
    if len(sources) < FEWEST_FRAMES:
        raise InputError(
            f"{len(sources)} frames",
            f"at least {FEWEST_FRAMES}, from different camera positions",
            "Give more of the video",
        )
    if not np.ptp(_camera_centers([frames[index] for index in sources]), axis=0).max() > 0.0:
        raise InputError(
            f"all {len(sources)} cameras are at the same position",
            "poses at different positions",
            "A camera that does not move, or only turns, gives no depth; check the poses",
        )
    sizes = sorted({(frame.camera.width, frame.camera.height) for frame in frames})
    if len(sizes) > 1:
        raise InputError(
            f"images of {sizes_text(sizes)} pixels",
            "images of one size",
            f"`datamanager.width={sizes[0][0]}` and `datamanager.height={sizes[0][1]}` make them so, or estimate "
            "each camera's frames apart",
        )


def _camera_centers(frames: Sequence[Frame]) -> Float[np.ndarray, "N 3"]:
    return np.stack([frame.camera.center.cpu().double().numpy() for frame in frames])


def choose_neighbours(
    centers: Float[np.ndarray, "N 3"],
    axes: Float[np.ndarray, "N 3"],
    sources: Sequence[int],
    depths: Sequence[float],
    baselines: Sequence[float],
) -> list[list[int]]:
    """Neighbours of every frame of a video: for each baseline the first source so far away, before and after it.

    Where the video ends on one side, the other gives more frames, farther away. A pause adds no frames, as they are
    chosen by distance (in units of the frame's median depth), not by number.
    """
    baselines = sorted(baselines)
    farther = [baselines[-1] + (baselines[-1] / len(baselines)) * step for step in range(1, len(baselines) + 1)]
    least_cosine = np.cos(np.radians(MAX_TURN))
    candidates = np.asarray(sources)
    neighbours = []
    for index in range(len(centers)):
        distance = np.linalg.norm(centers - centers[index], axis=1) / depths[index]
        is_candidate = (axes @ axes[index] >= least_cosine) & (distance <= MAX_BASELINE)
        before, after = candidates[candidates < index][::-1], candidates[candidates > index]
        sides = [_first_beyond(distance, side, is_candidate, baselines) for side in (before, after)]
        for longer, shorter, side in ((0, 1, before), (1, 0, after)):
            lacking = len(baselines) - len(sides[shorter])
            if lacking > 0:
                sides[longer] = _first_beyond(distance, side, is_candidate, [*baselines, *farther[:lacking]])
        neighbours.append(sorted({*sides[0], *sides[1]}))
    return neighbours


def _first_beyond(
    distance: np.ndarray, side: np.ndarray, is_candidate: np.ndarray, baselines: Sequence[float]
) -> list[int]:
    """The first frame of one side of the video beyond each baseline, without repetition."""
    chosen = []
    for baseline in baselines:
        beyond = side[(distance[side] >= baseline) & is_candidate[side]]
        if len(beyond) and int(beyond[0]) not in chosen:
            chosen.append(int(beyond[0]))
    return chosen
