"""A scene with estimated depth, made from one without."""

from __future__ import annotations

import logging
import os
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from jaxtyping import Float, Float32, Int, UInt8

from coliags_plugin.core.depth_maps import Map, Pose
from coliags_plugin.core.errors import InputError
from coliags_plugin.core.files import atomic_folder
from coliags_plugin.core.jobs import Progress, with_progress
from coliags_plugin.core.scene_files import write_unit
from coliags_plugin.core.scenes import Frame, Scene
from coliags_plugin.core.splits import split_options
from coliags_plugin.datamanagers.nerfstudio import EstimatedSceneWriter
from coliags_plugin.datamanagers.shots import PAPER_SIZE, fitted
from coliags_plugin.reconstruction.depth.estimate import Estimation, check_video, work_folder
from coliags_plugin.reconstruction.depth.priors import DepthRange, FilePrior, LightPrior, find_range
from coliags_plugin.reconstruction.depth.sweeping import DepthEstimationSettings
from coliags_plugin.reconstruction.structure.features import image_and_mask

log = logging.getLogger(__name__)

#: Confidence from which a pixel counts as known in the summary.
_KNOWN = 0.5
#: Changes when the results of the same request do, so that old work files are not mixed with new ones.
_VERSION = 7
#: Edge of the voxels of points, pixels on the surface.
_VOXEL = 2.0


def estimate_scene(
    scene: Scene,
    out: Path,
    settings: DepthEstimationSettings,
    near_far: tuple[float, float] | None = None,
    prior: Path | None = None,
    jobs: int | None = None,
    overwrite: bool = False,
    progress: Progress | None = None,
) -> tuple[str, list[str], float]:
    """Estimate the depth of a posed scene's video, and write it as a scene in nerfstudio's layout.

    The depth of training frames, the range and the points are made of training frames alone; that of a test frame of
    its own image and training frames. Test sets of other names are left out. Work files stay beside ``out`` until all
    is written, and the same request resumes from them.

    ``near_far`` is the depth range, scene units, which is found where it is None; ``prior`` a folder of depth maps in
    place of the brightness; ``jobs`` the number of threads, one for each core by default. Returns a summary, warnings
    (for each reason, which frames have confidence 0 throughout), and the share of the pixels with known depth.
    """
    frames = scene.video
    trained = {frame.name for frame in scene.train}
    sources = [index for index, frame in enumerate(frames) if frame.name in trained]
    if others := [name for name in scene.test_sets if name != "test"]:
        log.warning("left out: %s, which are apart from the video", ", ".join(others))
    check_video(frames, sources)
    if near_far is not None and not 0.0 < near_far[0] < near_far[1]:
        raise InputError(f"`near={near_far[0]:g}` and `far={near_far[1]:g}`", "0 < near < far")
    depth_prior = LightPrior() if prior is None else FilePrior(prior, frames)
    described = {
        "version": _VERSION,
        "data": scene.provenance.fingerprint,
        "frames": [frame.name for frame in frames],
        "sources": sources,
        "size": [frames[0].camera.width, frames[0].camera.height],
        "poses": [frame.camera.camera_to_world.flatten().tolist() for frame in frames],
        "settings": settings.model_dump(),
        "near_far": near_far,
        "prior": depth_prior.described(),
    }
    with work_folder(out, described) as work:
        if near_far is None:
            used = [frames[index] for index in sources]
            measured = work.value("range", lambda: vars(find_range(used, settings.features, progress)))
            medians = np.exp(np.interp(np.arange(len(frames)), sources, np.log(measured["medians"])))
            depth_range = DepthRange(measured["near"], measured["far"], tuple(medians.tolist()))
        else:
            depth_range = DepthRange(*near_far, (float(np.sqrt(near_far[0] * near_far[1])),) * len(frames))
        jobs = jobs or os.cpu_count() or 1
        estimation = Estimation(frames, sources, depth_prior, depth_range, settings, work, jobs, progress)
        estimation.run()
        with atomic_folder(out, overwrite) as folder:
            result = _write(scene, frames, estimation, folder, progress)
    return result


def training_options(scene: Scene) -> list[str]:
    """Options of training with which the scene written for a source has its split and its size."""
    split, camera = scene.provenance.split, scene.train[0].camera
    options = [] if split is None else split_options(split.name, split.block)
    if fitted(camera.width, camera.height, PAPER_SIZE) != (camera.width, camera.height):
        options += [f"datamanager.width={camera.width}", f"datamanager.height={camera.height}"]
    return options


def _write(
    scene: Scene, frames: Sequence[Frame], estimation: Estimation, folder: Path, progress: Progress | None
) -> tuple[str, list[str], float]:
    writer = EstimatedSceneWriter(folder, estimation.range.far / 65000.0)
    k = frames[0].camera
    typical = np.median([estimation.medians[index] for index in estimation.sources])
    footprint = float(typical) / float(np.sqrt(k.fx * k.fy))
    voxels = VoxelPoints(_VOXEL * footprint, frames[len(frames) // 2].camera.center.cpu().double().numpy())
    pixels = confident = 0
    distrusted: dict[str, list[str]] = {}
    for index, stored in enumerate(with_progress(frames, "write", progress)):
        frame, (depth, confidence, distrust) = stored.to("cpu"), estimation.result(index)
        if distrust:
            distrusted.setdefault(distrust, []).append(frame.name)
        image, mask = image_and_mask(frame)
        if mask is not None:
            confidence = np.where(mask, confidence, np.float32(0.0))
        writer.write_frame(frame.name, frame.camera, image, mask, depth, confidence)
        if index in estimation.sources:
            voxels.add(Pose.of(frame.camera), depth, confidence, image)
        pixels += int(frame.valid.sum())
        confident += int((confidence >= _KNOWN).sum())
    positions, colors = voxels.points()
    share = confident / max(pixels, 1)
    if not len(positions):
        raise InputError(
            f"no surface that {len(frames)} frames agree on: {100.0 * share:.1f} % of the pixels have a confidence of "
            f"{_KNOWN:g} or more",
            "sharp frames of the same surface from different positions, with correct poses",
            "Check the poses (coliags check data), or the images: blurred or dark frames give no depth",
        )
    train = [frame.name for frame in scene.train]
    test = [frame.name for frame in scene.test_sets.get("test", ())]
    has_own_split = scene.provenance.split_name == "own"
    writer.finish(positions, colors, train, (train, test) if has_own_split else None)
    write_unit(folder, scene.provenance.unit)
    known = f"{100.0 * share:.0f} % of the pixels with a confidence of {_KNOWN:g} or more"
    summary = f"{len(frames)} frames, {known}; {len(positions)} points"
    warnings = [
        f"{len(names)} of {len(frames)} frames have depth of confidence 0, {reason}: {', '.join(names)}"
        for reason, names in distrusted.items()
    ]
    return summary, warnings, share


#: Least confidence of a pixel, and least number of frames that see a point's voxel.
LEAST_CONFIDENCE, FEWEST_FRAMES = 0.8, 3
#: Voxels are held as one integer: so many along each axis, the world's origin in the middle.
_SPAN = 1 << 20


class VoxelPoints:
    """Points merged in cubic voxels of the world, frame by frame; memory grows with the surface, not the frames.

    ``size``: of the voxels, scene units; ``origin``: a position amid the scene.
    """

    def __init__(self, size: float, origin: Float[np.ndarray, "3"]) -> None:
        self.size, self.origin = size, np.asarray(origin, np.float64)
        self._keys: Int[np.ndarray, "V"] = np.zeros(0, np.int64)
        #: Sums of weight, weighted offset from the origin and weighted colour, and the number of frames. [V, 8]
        self._sums: Float[np.ndarray, "V 8"] = np.zeros((0, 8))

    def add(self, pose: Pose, depth: Map, confidence: Map, image: UInt8[np.ndarray, "H W 3"]) -> None:
        """Add a frame's pixels of z-depth with a confidence of at least ``LEAST_CONFIDENCE``."""
        # Not at a depth discontinuity: a tenth or more between the neighbours on both sides.
        log_depth, steep = np.log(depth), np.zeros(depth.shape, bool)
        steep[1:-1] |= np.abs(log_depth[2:] - log_depth[:-2]) > 0.1
        steep[:, 1:-1] |= np.abs(log_depth[:, 2:] - log_depth[:, :-2]) > 0.1
        chosen = (confidence >= LEAST_CONFIDENCE) & ~steep
        weight = confidence[chosen].astype(np.float64)[:, None]
        local = (pose.rays() * depth[..., None])[chosen]
        offset = local @ pose.camera_to_world[:3, :3].T + pose.camera_to_world[:3, 3] - self.origin
        cell = np.floor(offset / self.size).astype(np.int64) + _SPAN // 2
        inside = ((cell >= 0) & (cell < _SPAN)).all(axis=1)
        keys = (cell[:, 0] * _SPAN + cell[:, 1]) * _SPAN + cell[:, 2]
        rows = np.concatenate([weight, weight * offset, weight * image[chosen]], axis=1)[inside]
        frame_keys, cells = np.unique(keys[inside], return_inverse=True)
        sums = np.stack([np.bincount(cells, column, len(frame_keys)) for column in rows.T], axis=1)
        sums = np.hstack([sums, np.ones((len(frame_keys), 1))])
        place = np.searchsorted(self._keys, frame_keys)
        is_known = np.append(self._keys, -1)[place] == frame_keys
        self._sums[place[is_known]] += sums[is_known]
        self._keys = np.insert(self._keys, place[~is_known], frame_keys[~is_known])
        self._sums = np.insert(self._sums, place[~is_known], sums[~is_known], axis=0)

    def points(self) -> tuple[Float32[np.ndarray, "N 3"], UInt8[np.ndarray, "N 3"]]:
        """Weighted mean position and colour of every voxel that ``FEWEST_FRAMES`` frames have points in."""
        sums = self._sums[self._sums[:, 7] >= FEWEST_FRAMES]
        weight = sums[:, :1]
        positions = sums[:, 1:4] / weight + self.origin
        return positions.astype(np.float32), np.rint(sums[:, 4:7] / weight).astype(np.uint8)
