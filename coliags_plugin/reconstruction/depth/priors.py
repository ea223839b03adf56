"""Depth range of a posed video from features; priors by a lamp at the lens or by depth maps of others; completion."""

from __future__ import annotations

import hashlib
import logging
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

import numpy as np
from jaxtyping import Float, Float32, UInt8
from scipy.spatial import cKDTree

from coliags_plugin.core.depth_maps import Map, Pose
from coliags_plugin.core.errors import InputError
from coliags_plugin.core.jobs import Progress, with_progress
from coliags_plugin.core.scene_files import files_in, first_few
from coliags_plugin.core.scenes import Frame
from coliags_plugin.datamanagers.file_formats import read_exr_channel, scaled_depth
from coliags_plugin.reconstruction.depth.sweeping import MAX_TURN, Mask
from coliags_plugin.reconstruction.structure.features import (
    Features,
    feature_extractor,
    have_positive_depths,
    image_and_mask,
    mutual_matches,
    quiet_colmap,
    rays,
)
from coliags_plugin.reconstruction.structure.sfm_settings import FeatureSettings

log = logging.getLogger(__name__)

#: Most frames whose depth is measured, and how many frames later their partners are.
_FRAMES, _STEPS = 16, (1, 2, 4, 8, 16)
#: Least triangulation angle, degrees, and largest Sampson distance, pixels.
_LEAST_ANGLE, _ERROR = 1.0, 1.0
#: Fewest points that give a range, and that give a frame's own median.
_FEWEST_POINTS, _FEWEST_OF_FRAME = 30, 10
#: Relative difference within which two partners must agree about a point.
_AGREEMENT = 0.15
#: Difference of log depth from the neighbours' above which a point does not count.
_UNLIKE = 0.3
#: Neighbours of a point in its frame, and how many of them have to agree: a fold's edge leaves one side.
_NEIGHBOURS, _AGREEING = 8, 4
#: Percentiles of the points' depth, and the factors on them: features are rare where the lumen is dark.
_NEAREST, _FARTHEST = (1.0, 0.6), (99.0, 2.0)


@dataclass(frozen=True)
class DepthRange:
    """Nearest and farthest depth of a video, and each frame's median, scene units."""

    near: float
    far: float
    medians: tuple[float, ...]


def find_range(frames: Sequence[Frame], settings: FeatureSettings, progress: Progress | None = None) -> DepthRange:
    """Depth range from points triangulated between pairs of frames, or from sparse depth where the scene has some."""
    if any(frame.sparse_depth is not None and len(frame.sparse_depth.depth) for frame in frames):
        depths_by_frame = [
            np.zeros(0)
            if sparse is None
            else neighbourly(sparse.pixels.cpu().numpy(), sparse.depth.cpu().double().numpy())
            for sparse in (frame.sparse_depth for frame in frames)
        ]
        return _range_of(depths_by_frame, "points of the scene")
    depths_by_frame = [np.zeros(0)] * len(frames)
    chosen = np.unique(np.linspace(0, len(frames) - 1, min(_FRAMES, len(frames))).round().astype(int)).tolist()
    with quiet_colmap(0):
        extract = feature_extractor(settings)

        @lru_cache(maxsize=2 * len(_STEPS))
        def features_of(index: int) -> Features:
            return extract(*image_and_mask(frames[index]))

        for index in with_progress(chosen, "find the depth range", progress):
            partners = [index + step for step in _STEPS if index + step < len(frames)]
            partners += [index - step for step in _STEPS if index - step >= 0 and not partners]
            depths = [
                triangulated_depths(features_of(index), features_of(other), frames[index], frames[other])
                for other in partners
            ]
            if depths:
                depths_by_frame[index] = neighbourly(features_of(index).pixels, _agreed(np.stack(depths)))
    return _range_of(depths_by_frame, "points triangulated between frames")


def triangulated_depths(first: Features, second: Features, frame: Frame, partner: Frame) -> Float[np.ndarray, "K"]:
    """z-depths, in the first frame, of its features with matches on their epipolar lines at a sufficient angle.

    NaN for all others.
    """
    depths = np.full(len(first), np.nan)
    rotation, translation = Pose.of(frame.camera).to(Pose.of(partner.camera))
    turn = np.degrees(np.arccos(np.clip(float(frame.camera.optical_axis @ partner.camera.optical_axis), -1.0, 1.0)))
    if not np.linalg.norm(translation) > 0.0 or turn > MAX_TURN:
        return depths
    pairs = mutual_matches(first, second)
    turned = rays(first.pixels[pairs[:, 0]], frame.camera) @ rotation.T
    opposite = rays(second.pixels[pairs[:, 1]], partner.camera)
    # Epipolar lines in either image; coefficients of x and y divided by the focal lengths give distances in pixels.
    lines, lines_back = np.cross(translation, turned), np.cross(opposite, translation) @ rotation
    slopes = (
        np.linalg.norm(line[:, :2] / (camera.fx, camera.fy), axis=1)
        for line, camera in ((lines, partner.camera), (lines_back, frame.camera))
    )
    is_on_line = np.abs((opposite * lines).sum(axis=1)) <= _ERROR * np.hypot(*slopes)
    # Depth a of least distance between the lines a * turned + translation and b * opposite.
    aa, bb, ab = (np.einsum("ij,ij->i", *pair) for pair in ((turned, turned), (opposite, opposite), (turned, opposite)))
    sine = 1.0 - ab**2 / (aa * bb)
    with np.errstate(divide="ignore", invalid="ignore"):
        depth = (ab * (opposite @ translation) - bb * (turned @ translation)) / (aa * bb - ab**2)
    good = is_on_line & (sine > np.sin(np.radians(_LEAST_ANGLE)) ** 2)
    good &= have_positive_depths(turned, opposite, translation)
    depths[pairs[good, 0]] = depth[good]
    return depths


def _agreed(depths: Float[np.ndarray, "P K"]) -> Float[np.ndarray, "K"]:
    """Median depths of the features about which two partners agree, and most do; NaN for all others."""
    there = (~np.isnan(depths)).sum(axis=0)
    agreed = np.full(depths.shape[1], np.nan)
    enough = there >= min(2, len(depths))
    agreed[enough] = np.nanmedian(depths[:, enough], axis=0)
    near = (np.abs(depths / agreed - 1.0) <= _AGREEMENT).sum(axis=0)
    return np.where((near >= np.minimum(2, there)) & (2 * near > there), agreed, np.nan)


def neighbourly(pixels: Float[np.ndarray, "K 2"], depths: Float[np.ndarray, "K"]) -> Float[np.ndarray, "A"]:
    """Depths of one frame that are known, above 0, and not unlike half of the nearest others; all of too few."""
    is_known = depths > 0.0
    pixels, depths = pixels[is_known], depths[is_known]
    if len(depths) <= _NEIGHBOURS:
        return depths
    nearest = np.asarray(cKDTree(pixels).query(pixels, _NEIGHBOURS + 1)[1])[:, 1:]
    log_depth = np.log(depths)
    differences = np.abs(log_depth[nearest] - log_depth[:, None])
    return depths[~(np.partition(differences, _AGREEING - 1, axis=1)[:, _AGREEING - 1] > _UNLIKE)]


def _range_of(depths_by_frame: Sequence[Float[np.ndarray, "K"]], what: str) -> DepthRange:
    every = np.concatenate(depths_by_frame)
    if len(every) < _FEWEST_POINTS:
        raise InputError(
            f"the depth range is unknown: {len(every)} {what}",
            f"at least {_FEWEST_POINTS}: sharp, overlapping frames of a camera that moves, with correct poses",
            "Check the poses (coliags check data), use frames farther apart, or give `near` and `far`",
        )
    near, far = (factor * float(np.percentile(every, part)) for part, factor in (_NEAREST, _FARTHEST))
    measured = [index for index, depths in enumerate(depths_by_frame) if len(depths) >= _FEWEST_OF_FRAME]
    if measured:
        medians = np.interp(
            np.arange(len(depths_by_frame)), measured, np.log([np.median(depths_by_frame[index]) for index in measured])
        )
    else:
        medians = np.full(len(depths_by_frame), np.log(np.median(every)))
    log.info("depths of %.4g to %.4g are tried, by %d %s", near, far, len(every), what)
    return DepthRange(near, far, tuple(float(value) for value in np.exp(medians)))


#: Exponent from stored to linear intensity, and the least linear intensity.
_GAMMA, _DARKEST = 2.2, 2e-4
#: Standard deviations of smoothing, pixels; the last that reaches usable pixels counts.
_SIGMAS = (24.0, 6.0, 1.5)
#: Weight of the physical law, in pixels: what a frame with few known depths falls back to.
_LAW_WEIGHT = 20.0


class LightPrior:
    """Log depth as a polynomial of log red, log green and the cosine to the optical axis, fitted to each frame.

    Seven numbers: constant, both logarithms, their squares and product, and the cosine. Where depth is hardly known
    the fit stays at the law of a lamp at the lens, intensity ~ 1 / depth^2 (docs/depth.md).
    """

    def log_depth(self, frame: Frame, usable: Mask, log_known: Map, weight: Map, typical: float) -> Map:
        """Log of z-depth at every pixel of a frame, of the size of the maps or larger, fitted to its known depth.

        ``usable``: neither masked nor near a highlight; ``log_known``: log of z-depth, anything where its ``weight``, 0
        to 1, is 0; ``typical``: z-depth of a typical pixel, for a frame without known depth.
        """
        import cv2

        size = (log_known.shape[1], log_known.shape[0])
        image = cv2.resize(frame.image.cpu().numpy(), size, interpolation=cv2.INTER_AREA)
        design = light_terms(image, usable, Pose.of(frame.camera, size))
        columns = design.reshape(-1, design.shape[-1])
        chosen = np.flatnonzero((weight > 0.0) & usable)
        law = np.zeros(columns.shape[1])
        law[2] = -0.5
        lit = columns[usable.ravel()] if usable.any() else columns
        law[0] = np.log(typical) - law[2] * float(np.median(lit[:, 2]))
        fitted = robust_fit(columns[chosen], log_known.ravel()[chosen], weight.ravel()[chosen], law, _LAW_WEIGHT)
        # Beyond what the fit has seen, a polynomial runs away: hold its terms at the ends.
        if len(chosen) > 1000:
            low, high = np.percentile(columns[chosen], [0.05, 99.95], axis=0)
            slack = 0.15 * (high - low)
            columns = np.clip(columns, low - slack, high + slack)
        return np.asarray((columns @ fitted).reshape(log_known.shape), np.float32)

    def described(self) -> str:
        """Name of the prior, by which work files of another one are told."""
        return "light"


def light_terms(image: UInt8[np.ndarray, "H W 3"], usable: Mask, pose: Pose) -> Float[np.ndarray, "H W 7"]:
    """Terms of the polynomial: 1, log red, log green, their squares and product, cosine to the optical axis.

    Colours are smoothed over a few pixels, without those that are not usable; these take the colours around them.
    """
    import cv2

    linear = (image[..., :2].astype(np.float32) / 255.0) ** _GAMMA
    good = usable.astype(np.float32)
    smooth = linear
    for sigma in _SIGMAS:
        share = cv2.GaussianBlur(good, (0, 0), sigma)[..., None]
        around = cv2.GaussianBlur(linear * good[..., None], (0, 0), sigma) / np.maximum(share, 1e-3)
        smooth = np.where(share > 0.05, around, smooth)
    red, green = np.moveaxis(np.log(np.maximum(smooth, _DARKEST)).astype(np.float64), -1, 0)
    cosine = 1.0 / np.linalg.norm(pose.rays(), axis=-1)
    return np.stack([np.ones_like(red), red, green, red * red, red * green, green * green, cosine], axis=-1)


_SUFFIXES = (".png", ".npy", ".tiff", ".tif", ".exr")
#: How far the aspect ratio of a map may be from the frame's: rounding to whole pixels, but no cropping.
_ASPECT = 0.02
#: Fewest known pixels that scale and shift are fitted to.
_FEWEST = 50


class FilePrior:
    """Depth maps from files, scale and shift fitted to each frame's known depth, as depth or as inverse depth.

    The folder has one map of each frame, named as the frame, of its aspect ratio.
    """

    def __init__(self, folder: Path, frames: Sequence[Frame]) -> None:
        if not folder.is_dir():
            raise InputError(f"`prior={folder}`: no such folder", "a folder of depth maps named as the images")
        files = {path.stem: path for path in files_in(folder, _SUFFIXES)}
        missing = [frame.name for frame in frames if frame.name not in files]
        if missing:
            raise InputError(
                f"`prior={folder}`: {len(missing)} of {len(frames)} frames have no depth map: {first_few(missing)}",
                f"NAME{', NAME'.join(_SUFFIXES)} for every frame",
                "Name the maps as the images",
            )
        self.files = {frame.name: files[frame.name] for frame in frames}
        for frame in frames:
            self._read(frame)

    def described(self) -> str:
        """Hash of the maps' names and contents."""
        digest = hashlib.sha256()
        for name, path in self.files.items():
            digest.update(name.encode() + path.read_bytes())
        return digest.hexdigest()

    def log_depth(self, frame: Frame, usable: Mask, log_known: Map, weight: Map, typical: float) -> Map:
        """Log of z-depth as by :meth:`LightPrior.log_depth`; unknown pixels of a map take the typical depth."""
        import cv2

        size = (log_known.shape[1], log_known.shape[0])
        stored = self._read(frame)
        values = np.asarray(cv2.resize(stored, size, interpolation=cv2.INTER_NEAREST), np.float64)
        there = np.isfinite(values) & (values > 0.0)
        chosen = (weight > 0.0) & usable & there
        nothing = np.full(log_known.shape, np.log(typical), np.float32)
        if not there.any():
            return nothing
        if chosen.sum() < _FEWEST:
            scale = np.median(values[there])
            return np.where(there, np.log(typical * np.where(there, values, scale) / scale), nothing).astype(np.float32)
        best, least = nothing, np.inf
        for power in (1.0, -1.0):
            target = np.exp(power * log_known[chosen].astype(np.float64))
            columns = np.stack([np.ones(values.shape), np.where(there, values, 1.0)], axis=-1)
            fit = columns @ robust_fit(columns[chosen], target, weight[chosen], np.zeros(2), 1e-9)
            # A line may leave the positive depths: hold it at a tenth of the least that is known.
            fit = np.clip(fit, 0.1 * target.min(), 10.0 * target.max())
            log_depth = np.log(fit) / power
            error = float(np.average(np.abs(log_depth[chosen] - log_known[chosen]), weights=weight[chosen]))
            if error < least:
                best, least = np.where(there, log_depth, nothing).astype(np.float32), error
        return best

    def _read(self, frame: Frame) -> Float32[np.ndarray, "h w"]:
        path = self.files[frame.name]
        if path.suffix.lower() == ".exr":
            stored = read_exr_channel(path, "V", "Rename it, or convert the maps to .npy")
        else:
            form = scaled_depth(path, 1.0)
            stored = form.decode(form.read(path))[0]
        height, width = stored.shape
        camera = frame.camera
        if abs(width * camera.height / (height * camera.width) - 1.0) > _ASPECT:
            raise InputError(
                f"{path} has {width} x {height} pixels, frame {frame.name} {camera.width} x {camera.height}",
                "depth maps of the undistorted working image, of its aspect ratio",
                "Make them from the images of such a scene, or crop them likewise",
            )
        return np.asarray(stored, np.float32)


#: Reweighted solutions.
_ROUNDS = 8
#: Most rows that are used.
_MOST = 20_000


def robust_fit(
    columns: Float[np.ndarray, "N K"],
    values: Float[np.ndarray, "N"],
    weights: Float[np.ndarray, "N"],
    default: Float[np.ndarray, "K"],
    default_weight: float,
) -> Float[np.ndarray, "K"]:
    """Coefficients by least squares reweighted by Cauchy's function of the residual, its scale four median deviations.

    The first column is constant. ``default``, the solution without rows, draws it with the weight of ``default_weight``
    rows of unit weight.
    """
    if len(values) == 0:
        return default.copy()
    every = -(-len(values) // _MOST)
    rows, targets, trust = columns[::every], values[::every].astype(np.float64), weights[::every].astype(np.float64)
    rows = rows.astype(np.float64)
    scale = np.maximum(rows.std(axis=0), 1e-3)
    scale[0] = 1.0
    middle = np.average(rows, axis=0, weights=trust)
    middle[0] = 0.0
    standard = (rows - middle) / scale
    start = default * scale
    start[0] = default[0] + default[1:] @ middle[1:]
    pull = np.full(len(start), default_weight)
    pull[0] = 1e-3 * default_weight  # the level follows the data at once
    solution, residuals = start, targets - standard @ start
    for _ in range(_ROUNDS):
        spread = max(4.0 * float(np.median(np.abs(residuals - np.median(residuals)))), 1e-4)
        centred = residuals - (np.median(residuals) if solution is start else 0.0)
        each = trust / (1.0 + (centred / spread) ** 2)
        normal = standard.T @ (each[:, None] * standard) + np.diag(pull)
        solution = np.linalg.solve(normal, standard.T @ (each * targets) + pull * start)
        residuals = targets - standard @ solution
    coefficients = solution / scale
    coefficients[0] = solution[0] - coefficients[1:] @ middle[1:]
    return np.asarray(coefficients)


#: Fast global smoother: strength, and the difference of the 8-bit guide at which smoothing ceases.
_STRENGTH, _EDGE = 10.0, 12.0
#: The same of surfaces that are swept.
_SURFACE_STRENGTH, _SURFACE_EDGE = 10.0, 6.0
#: Grey levels of the guide for each unit of log intensity.
_LEVELS = 60.0
#: Weight of a residual of zero at every pixel, relative to a known pixel's one.
_ZERO = 1e-4
#: Log depth across 5 pixels from which they are at a depth edge, and how much is believed of its near side.
_JUMP, _BELIEF = 0.06, 0.1
#: Support below which depth is not believed if it is off the prior by more than this, in log depth.
_FEW, _ABSURD = 1.5, 0.35


def complete(log_known: Map, support: Map, belief: Map, log_prior: Map, intensity: Map) -> Map:
    """Log depth that keeps to what is known and elsewhere is the prior plus a smooth residual.

    The residual is known depth minus prior, spread by an edge-aware global smoother (Min et al. 2014) normalised by
    the spread weight. Depth that several frames agree on is kept; what has less support is mixed with the smooth one.
    ``support`` is the weighted number of frames that agree, 0 where depth is unknown; ``belief``, 0 to 1, how much of
    it counts; edges of the log ``intensity`` stop the smoothing.
    """
    data = data_weight(support) * belief
    smooth = _smoother(intensity, _STRENGTH, _EDGE)
    residual = np.where(data > 0.0, log_known - log_prior, 0.0).astype(np.float32)
    filled = log_prior + smooth(data * residual) / (smooth(data) + np.float32(_ZERO))
    position = np.clip((support - 0.2) / 0.8, 0.0, 1.0)
    share = position * position * (3.0 - 2.0 * position) * belief
    return np.asarray(np.where(share > 0.0, share * log_known + (1.0 - share) * filled, filled), np.float32)


def first_belief(log_known: Map, support: Map, log_prior: Map, rim: Mask) -> Map:
    """Belief in a sweep without a surface to start from, 0 to 1.

    Large windows make a near surface too wide at its edges: there, its rim (:func:`near_rim`) has little weight, and
    the edges of the image decide. Depth with little support that is far off the prior is not believed.
    """
    absurd = (support < _FEW) & (np.abs(log_known - log_prior) > _ABSURD)
    return np.where(absurd, 0.0, np.where(rim, _BELIEF, 1.0)).astype(np.float32)


def smooth_surface(depth: Float32[np.ndarray, "h w"], intensity: Map) -> Map:
    """z-depth at the size of a log image and smoothed up to its edges, as a surface to sweep.

    Windows of correlation lie on the surface: where its slant is wrong, so is what they find.
    """
    import cv2

    resized = cv2.resize(depth, intensity.shape[::-1], interpolation=cv2.INTER_LINEAR)
    log_depth = np.log(resized.astype(np.float32))
    return np.asarray(np.exp(_smoother(intensity, _SURFACE_STRENGTH, _SURFACE_EDGE)(log_depth)), np.float32)


def data_weight(support: Map) -> Map:
    """Weight of known depth beside other known depth, where priors are fitted and residuals spread: 0 to 1."""
    return np.where(support > 0.0, np.minimum(0.3 + support, 1.0), 0.0).astype(np.float32)


def near_rim(log_depth: Map, reach: int) -> Mask:
    """Pixels on the near side of a depth edge, within ``reach`` pixels of it."""
    import cv2

    values = cv2.medianBlur(log_depth, 5)
    small, wide = (np.ones((2 * side + 1, 2 * side + 1), np.uint8) for side in (2, reach))
    edge = (cv2.dilate(values, small) - cv2.erode(values, small) > _JUMP).astype(np.uint8)
    middle = 0.5 * (cv2.dilate(values, wide) + cv2.erode(values, wide))
    return np.asarray((cv2.dilate(edge, wide) > 0) & (values < middle))


def _smoother(intensity: Map, strength: float, edge: float) -> Callable[[Map], Map]:
    """An edge-aware global smoother (Min et al. 2014) guided by log intensity."""
    import cv2

    guide = np.clip(128.0 + _LEVELS * intensity, 0, 255).astype(np.uint8)
    return cv2.ximgproc.createFastGlobalSmootherFilter(guide, strength, edge).filter
