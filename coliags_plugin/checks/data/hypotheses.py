"""Agreement of frames under several readings of their poses: of depth reprojected, and of matched points."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from coliags_plugin.core.cameras import Camera
from coliags_plugin.core.depth_maps import Pose
from coliags_plugin.core.jobs import Progress, with_progress
from coliags_plugin.core.scenes import Frame
from coliags_plugin.core.tensors import bilinear
from coliags_plugin.geometry.poses.trajectory import w_first
from coliags_plugin.reconstruction.structure.features import (
    feature_extractor,
    have_positive_depths,
    mutual_matches,
    quiet_colmap,
    rays,
)
from coliags_plugin.reconstruction.structure.point_tracks import track_between
from coliags_plugin.reconstruction.structure.sfm_settings import FeatureSettings

Change = Callable[[Float[Tensor, "4 4"]], Float[Tensor, "4 4"]]

#: The poses as they are.
GIVEN = "given"
#: Identity poses, the baseline that the given poses must beat.
NO_MOTION = "no motion"


def _transposed(pose: Tensor) -> Tensor:
    turned = pose.clone()
    turned[:3, :3] = pose[:3, :3].T
    return turned


def _with_w(pose: Tensor, is_first: bool) -> Tensor:
    return torch.from_numpy(w_first(pose[None].cpu().double().numpy(), is_first)[0]).to(pose)


CHANGES: dict[str, Change] = {
    GIVEN: lambda pose: pose,
    NO_MOTION: lambda pose: torch.eye(4, dtype=pose.dtype),
    "world-to-camera": torch.linalg.inv,
    "rotation transposed": _transposed,
    "translation of opposite sign": lambda pose: pose * pose.new_tensor([[1.0, 1.0, 1.0, -1.0]] * 3 + [[1.0] * 4]),
    "camera axes y up, z backward": lambda pose: pose * pose.new_tensor([1.0, -1.0, -1.0, 1.0]),
    "quaternions with w first": lambda pose: _with_w(pose, is_first=True),
    "world-to-camera quaternions with w last": lambda pose: torch.linalg.inv(
        _with_w(torch.linalg.inv(pose), is_first=False)
    ),
}

#: Advice where a hypothesis fits.
ADVICE = {
    "world-to-camera": "The poses look like world-to-camera transforms; write camera-to-world, their inverses",
    "rotation transposed": "The rotations look transposed: the program that wrote the file confused rows and columns",
    "translation of opposite sign": "The translations look negated: check the sign in the program that wrote the file",
    "camera axes y up, z backward": "The camera axes look like OpenGL's; negate the second and third column",
    "quaternions with w first": "The quaternions look as if w came first: put it last, or name the columns on top of a "
    "TUM file, '# timestamp tx ty tz qw qx qy qz'",
    "world-to-camera quaternions with w last": "The quaternions look as if w came last: COLMAP's order is QW QX QY QZ",
}


#: Largest number of pixels reprojected per frame.
_PIXELS = 4000
#: Factors on depth of the coarse search.
_SCALES = np.logspace(-4.0, 4.0, 65)
#: Least confidence of estimated depth that is compared: it follows a prior where little is known.
LEAST_CONFIDENCE = 0.8
#: Stride of the pixels used in that search.
_STRIDE = 8
#: Smallest share of pixels that project into the other image for a factor to count.
_MIN_SHARE = 0.2


class Pair:
    """Two frames with depth, the first of which is reprojected into the second under several pose hypotheses."""

    def __init__(self, source: Frame, target: Frame) -> None:
        depth, there = _trusted_depth(source), _trusted_depth(target)
        finite = torch.isfinite(depth).reshape(-1).nonzero()[:, 0]
        chosen = finite[:: max(1, len(finite) // _PIXELS)]
        own_axes = replace(source.camera, camera_to_world=torch.eye(4, dtype=torch.float64))
        self._source, self._target = source.camera, target.camera
        #: Points in the source camera's axes. [K, 3]
        self._points = own_axes.unproject(depth).reshape(-1, 3)[chosen]
        self._depth_there = there.reshape(-1)
        self._colors = source.image.reshape(-1, 3)[chosen].double()
        self._colors_there = target.image.reshape(-1, 3).double()

    @property
    def has_depth(self) -> bool:
        """Return whether there is depth to compare in both frames."""
        return bool(len(self._points) and torch.isfinite(self._depth_there).any())

    def reproject(self, change: Change, scale: float = 1.0, every: int = 1) -> tuple[float, Tensor, Tensor, Tensor]:
        """Reproject every n-th of the source's pixels, with both poses changed and both depths times ``scale``.

        Returns the share of them that project into the target image, in front of its camera; the difference of z-depth,
        relative and in scene units, where it is known [K]; and that of colour, grey levels. [L]
        """
        pose = change(self._source.camera_to_world.double())
        camera = changed(self._target, change)
        pixels, z = camera.project(self._points[::every] * scale @ pose[:3, :3].T + pose[:3, 3])
        lands, hit = _pixels_hit(pixels, z, camera)
        there = self._depth_there[hit] * scale
        difference = (z[lands] - there).abs()
        finite = torch.isfinite(difference)
        colors = _color_difference(self._colors[::every][lands], self._colors_there[hit])
        return float(lands.double().mean()), (difference / there)[finite], difference[finite], colors


@dataclass(frozen=True)
class Agreement:
    """Agreement of frames under one pose hypothesis: medians over the pixels of all pairs."""

    depth_error: float | None  # relative error of z-depth; None where no pixel hits known depth
    depth_difference: float | None  # the same in scene units
    color_error: float | None  # grey levels
    share: float  # share of pixels that project into the target image


def agreement(pairs: Sequence[Pair], change: str = GIVEN, scale: float = 1.0, every: int = 1) -> Agreement:
    """Reproject the first frame of every pair into the second; arguments as in :meth:`Pair.reproject`."""
    reprojected = [pair.reproject(CHANGES[change], scale, every) for pair in pairs]
    shares, depths, lengths, colors = zip(*reprojected, strict=True)
    return Agreement(_median(depths), _median(lengths), _median(colors), float(np.mean(shares)))


@dataclass(frozen=True)
class BestScale:
    """The factor on depth with the smallest reprojection error."""

    factor: float  # on depth
    depth_error: float  # relative error of z-depth with it
    beside: float  # the smaller of the errors with half and with twice the factor; infinite where nothing overlaps


def best_scale(pairs: Sequence[Pair]) -> BestScale | None:
    """The factor on depth with the smallest reprojection error; None if none fits."""

    def error(scale: float) -> float:
        result = agreement(pairs, scale=float(scale), every=_STRIDE)
        return np.inf if result.depth_error is None or result.share < _MIN_SHARE else result.depth_error

    errors = [error(scale) for scale in _SCALES]
    least = int(np.argmin(errors))
    if not np.isfinite(errors[least]):
        return None
    step = _SCALES[1] / _SCALES[0]
    fine = _SCALES[least] * step ** np.linspace(-1.0, 1.0, 17)
    fine_errors = [error(scale) for scale in fine]
    best = float(fine[int(np.argmin(fine_errors))])
    return BestScale(best, float(min(fine_errors)), float(min(error(0.5 * best), error(2.0 * best))))


def warp_image(source: Frame, target: Frame) -> tuple[Float[Tensor, "H W 3"], Bool[Tensor, "H W"]]:
    """The source image warped into the target view by the target's depth, and the mask of warped pixels."""
    depth, camera = _trusted_depth(target), source.camera
    pixels, z = changed(camera).project(changed(target.camera).unproject(depth).reshape(-1, 3))
    painted = bilinear(source.image.double(), pixels.nan_to_num(0.0).reshape(*depth.shape, 2))
    lands, hit = _pixels_hit(pixels, z, camera)
    # Points occluded in the source image are left out.
    shown = torch.zeros_like(lands)
    shown[lands] = (_trusted_depth(source).reshape(-1)[hit] - z[lands]).abs() < 0.05 * z[lands]
    return painted / 255.0, shown.reshape(depth.shape)


def _pixels_hit(pixels: Tensor, z: Tensor, camera: Camera) -> tuple[Tensor, Tensor]:
    """Mask of projected points that land in the image, in front of the camera, and the pixel index of each of these."""
    column, row = pixels.floor().nan_to_num(-1.0).clamp(-1, 1 << 20).long().unbind(-1)
    lands = (z > 0) & (column >= 0) & (column < camera.width) & (row >= 0) & (row < camera.height)
    return lands, row[lands] * camera.width + column[lands]


def _trusted_depth(frame: Frame) -> Float[Tensor, "H W"]:
    """A frame's z-depth, NaN where it is unknown, masked, or estimated with confidence below the least. [H, W]"""
    depth, confidence = frame.depth, frame.depth_confidence
    if depth is None:
        return torch.full(frame.image.shape[:2], torch.nan, dtype=torch.float64)
    trusted = frame.valid if confidence is None else frame.valid & (confidence >= LEAST_CONFIDENCE)
    return torch.where(trusted, depth.double(), torch.nan)


def changed(camera: Camera, change: Change = CHANGES[GIVEN]) -> Camera:
    """The camera in double precision with its pose read in another way."""
    return replace(camera, camera_to_world=change(camera.camera_to_world.double()))


def _color_difference(colors: Tensor, colors_there: Tensor) -> Tensor:
    """Mean absolute colour difference after matching the channels' medians, as lamp and gain change. [K]"""
    if not len(colors):
        return torch.zeros(0, dtype=torch.float64)
    factor = (colors_there.median(dim=0).values + 1.0) / (colors.median(dim=0).values + 1.0)
    return (colors * factor - colors_there).abs().mean(dim=1)


def _median(parts: Sequence[Tensor]) -> float | None:
    values = torch.cat(tuple(parts))
    return float(values.median()) if len(values) else None


#: Features that are matched.
_FEATURES = FeatureSettings(upright=False)
#: Smallest number of matches of a usable pair.
_MIN_MATCHES = 8
#: An epipolar geometry passes through seven matches whatever they are. Smallest share of the others that it explains if
#: they are right: of random ones, it is up to 0.18 in images of patients.
_FREE, _MIN_EXPLAINED = 7, 0.3
#: Largest epipolar distance of a good match, px.
_MAX_DISTANCE = 3.0
#: Largest median epipolar distance of matches that agree with the poses, px, and as a share of the image's width: true
#: poses of C3VD, registered to 0.3 mm, have 2.1 px at a width of 800.
_MAX_ERROR, _MAX_ERROR_SHARE = 2.0, 0.005
#: Largest distance of an inlier from the epipolar geometry estimated from its pair's matches, px.
_MAX_RESIDUAL = 1.5
#: Smallest parallax that tells whether a point is in front of the camera, px.
_MIN_PARALLAX = 2.0


@dataclass(frozen=True)
class FrameMatches:
    """Matched points of two frames: (column, row), pixel centres at integers + 0.5. [K, 2] each."""

    source: Frame
    target: Frame
    pixels: Float[np.ndarray, "K 2"]
    pixels_there: Float[np.ndarray, "K 2"]


@dataclass(frozen=True)
class EpipolarAgreement:
    """Agreement of matches with one pose hypothesis."""

    error: float  # median distance from the epipolar line, px
    #: share of the good matches with enough parallax whose point lies in front of both cameras; None where there are
    #: too few
    in_front: float | None
    parallax: float  # median displacement of the matches by the translation between the cameras, px
    count: int  # number of matches
    width: float  # width of the images, px, the mean of all pairs

    @property
    def agrees(self) -> bool:
        """Return whether the error is that of right poses: real ones are off by some share of the image."""
        return self.error <= max(_MAX_ERROR, _MAX_ERROR_SHARE * self.width)


def match(pairs: Sequence[tuple[Frame, Frame]]) -> list[FrameMatches]:
    """Mutual best matches of SIFT features that some epipolar geometry explains, whatever the poses.

    Pairs with few matches, or with no more that agree on a geometry than random ones would, are left out.
    """
    matches = []
    with quiet_colmap(0):
        extract = feature_extractor(_FEATURES)
        for pair in pairs:
            first, second = (extract(frame.image.numpy(), frame.valid.numpy()) for frame in pair)
            here, there = mutual_matches(first, second).T
            matches += _explained(*pair, first.pixels[here], second.pixels[there])
    return matches


def follow(stretches: Sequence[Sequence[Frame]], progress: Progress | None = None) -> list[FrameMatches]:
    """Points followed from the first to the last frame of each stretch, as those of structure from motion are.

    For videos whose frames have few features in common. Stretches through which few points survive, or whose points no
    epipolar geometry explains, are left out.
    """
    matches = []
    for stretch in with_progress(stretches, "follow points", progress):
        if len({frame.image.shape for frame in stretch}) > 1:
            continue
        images, masks = [frame.image.numpy() for frame in stretch], [frame.valid.numpy() for frame in stretch]
        matches += _explained(stretch[0], stretch[-1], *track_between(images, masks))
    return matches


def _explained(source: Frame, target: Frame, here: np.ndarray, there: np.ndarray) -> list[FrameMatches]:
    """Matches of two frames that fit one epipolar geometry, as a list of one; an empty list where they are too few."""
    inlier = supported(here, there)
    return [] if inlier is None else [FrameMatches(source, target, here[inlier], there[inlier])]


def supported(here: Float[np.ndarray, "K 2"], there: Float[np.ndarray, "K 2"]) -> Bool[np.ndarray, "K"] | None:
    """Matches that one fundamental matrix explains; None if they are few, or no more than of random ones."""
    import cv2

    if len(here) < _MIN_MATCHES:
        return None
    try:
        _, mask = cv2.findFundamentalMat(here, there, cv2.USAC_MAGSAC, _MAX_RESIDUAL, 0.999, 10_000)
    except cv2.error:  # raised instead of returning nothing where all samples are degenerate
        return None
    inlier = np.zeros(len(here), bool) if mask is None else np.asarray(mask[:, 0] > 0)
    return inlier if inlier.sum() >= max(_MIN_MATCHES, _FREE + _MIN_EXPLAINED * (len(here) - _FREE)) else None


def epipolar_agreement(matches: Sequence[FrameMatches], change: str = GIVEN) -> EpipolarAgreement | None:
    """Epipolar errors under the hypothesis ``change``; None without matches or camera motion."""
    errors = [error for pair in matches if (error := _epipolar_errors(pair, change)) is not None]
    if not errors:
        return None
    distance, front, parallax = (np.concatenate(values) for values in zip(*errors, strict=True))
    good = distance < _MAX_DISTANCE
    in_front = None if good.any() else 0.0
    good &= parallax > _MIN_PARALLAX
    if good.sum() >= _MIN_MATCHES:
        in_front = float(front[good].mean())
    width = float(np.mean([pair.target.camera.width for pair in matches]))
    return EpipolarAgreement(float(np.median(distance)), in_front, float(np.median(parallax)), len(distance), width)


def _epipolar_errors(pair: FrameMatches, change: str) -> tuple[np.ndarray, np.ndarray, np.ndarray] | None:
    """Distances from the epipolar lines, px; whether points are in front of both cameras; parallax, px. [K] each"""
    camera, there = (changed(frame.camera, CHANGES[change]) for frame in (pair.source, pair.target))
    rotation, translation = Pose.of(camera).to(Pose.of(there))
    length = float(np.linalg.norm(translation))
    if length == 0.0:
        return None
    turned, target = rays(pair.pixels, camera) @ rotation.T, rays(pair.pixels_there, there)
    lines, focal = np.cross(translation / length, turned), np.array([there.fx, there.fy])
    distance = np.abs((target * lines).sum(axis=1)) / np.linalg.norm(lines[:, :2] / focal, axis=1)
    with np.errstate(divide="ignore", invalid="ignore"):
        moved = np.linalg.norm((turned[:, :2] / turned[:, 2:] - target[:, :2]) * focal, axis=1)
    parallax = np.where(turned[:, 2] > 0.0, moved, np.inf)
    return distance, have_positive_depths(turned, target, translation), parallax
