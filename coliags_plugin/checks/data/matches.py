"""Epipolar check of poses without depth: matched points must lie on epipolar lines, in front of both cameras."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float

from coliags_plugin.checks.data.reprojection import CHANGES, GIVEN, changed
from coliags_plugin.core.progress import Progress, with_progress
from coliags_plugin.core.scenes import Frame
from coliags_plugin.reconstruction.structure.features import FeatureSettings, feature_extractor, quiet_colmap
from coliags_plugin.reconstruction.structure.matching import Pose, have_positive_depths, mutual_matches, rays
from coliags_plugin.reconstruction.structure.point_tracks import PointTracker
from coliags_plugin.reconstruction.structure.sfm_settings import TrackSettings

#: Features that are matched; largest ratio in Lowe's test, and largest distance of descriptors.
_FEATURES, _MAX_RATIO, _MAX_DESCRIPTOR_DISTANCE = FeatureSettings(upright=False), 0.8, 0.7
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
        """Whether the error is that of right poses: real ones are off by some share of the image."""
        return self.error <= max(_MAX_ERROR, _MAX_ERROR_SHARE * self.width)


def match(pairs: Sequence[tuple[Frame, Frame]]) -> list[FrameMatches]:
    """Mutual best matches of SIFT features that some epipolar geometry explains, whatever the poses.

    Pairs with few matches, or with no more that agree on a geometry than random ones would, are left out.
    """
    matches = []
    with quiet_colmap(0):
        extract = feature_extractor(_FEATURES)
        for pair in pairs:
            one, other = (extract(frame.image.numpy(), frame.valid.numpy()) for frame in pair)
            here, there = mutual_matches(one, other, _MAX_RATIO, _MAX_DESCRIPTOR_DISTANCE).T
            matches += _explained(*pair, one.pixels[here], other.pixels[there])
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
        # Bridges would find points again after a gap, of which most are not needed.
        tracker = PointTracker(TrackSettings(bridge_below=0))
        points = [tracker.advance(frame.image.numpy(), frame.valid.numpy()) for frame in stretch]
        _, here, there = np.intersect1d(points[0].ids, points[-1].ids, assume_unique=True, return_indices=True)
        pixels, pixels_there = (
            of.pixels[rows].astype(np.float64) for of, rows in ((points[0], here), (points[-1], there))
        )
        matches += _explained(stretch[0], stretch[-1], pixels, pixels_there)
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
        _, found = cv2.findFundamentalMat(here, there, cv2.USAC_MAGSAC, _MAX_RESIDUAL, 0.999, 10_000)
    except cv2.error:  # raised instead of returning nothing where all samples are degenerate
        found = None
    inlier = np.zeros(len(here), bool) if found is None else np.asarray(found[:, 0] > 0)
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
    turned, seen = rays(pair.pixels, camera) @ rotation.T, rays(pair.pixels_there, there)
    lines, focal = np.cross(translation / length, turned), np.array([there.fx, there.fy])
    distance = np.abs((seen * lines).sum(axis=1)) / np.linalg.norm(lines[:, :2] / focal, axis=1)
    with np.errstate(divide="ignore", invalid="ignore"):
        moved = np.linalg.norm((turned[:, :2] / turned[:, 2:] - seen[:, :2]) * focal, axis=1)
    parallax = np.where(turned[:, 2] > 0.0, moved, np.inf)
    return distance, have_positive_depths(turned, seen, translation), parallax
