"""Triangulation of surface points from images with known poses, by COLMAP."""

from __future__ import annotations

import logging
import tempfile
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import torch
from jaxtyping import Bool, Float, Int, UInt8
from pydantic import Field

from coliags_plugin.core.errors import InputError
from coliags_plugin.core.progress import Progress, with_progress
from coliags_plugin.core.scenes import Frame
from coliags_plugin.core.settings import Settings
from coliags_plugin.reconstruction.libraries import quiet_colmap
from coliags_plugin.reconstruction.structure.colmap_database import frame_model, write_database
from coliags_plugin.reconstruction.structure.features import (
    Features,
    FeatureSettings,
    feature_extractor,
    image_and_mask,
)
from coliags_plugin.reconstruction.structure.mapping import brightness_at
from coliags_plugin.reconstruction.structure.matching import (
    Matches,
    all_pairs,
    check_motion,
    epipolar_matches,
    video_pairs,
)
from coliags_plugin.reconstruction.structure.outliers import (
    difference_from_lamp,
    difference_from_neighbours,
    median_of_points,
)
from coliags_plugin.reconstruction.structure.tracks import Tracks, uncertainty, widest_angles

if TYPE_CHECKING:
    import pycolmap

log = logging.getLogger(__name__)

#: Least number of points of a valid result.
FEWEST_POINTS = 10


class TriangulationSettings(Settings):
    """Options of matching and point filtering. Pixels are those of the images in which features are detected."""

    features: FeatureSettings = FeatureSettings()
    """Feature extraction."""
    overlap: int = Field(
        default=6,
        ge=1,
        description="Sequential matching: each frame with the next 1, 2, ..., overlap frames, and with those 2, 4, "
        "..., 2^(overlap - 1) frames ahead.",
    )
    exhaustive_up_to: int = Field(default=12, ge=0, description="Up to this many frames are matched exhaustively.")
    max_epipolar_error: float = Field(
        default=1.5,
        gt=0.0,
        description="Largest Sampson distance of a match from the epipolar geometry of the given poses, pixels.",
    )
    max_ratio: float = Field(
        default=0.7,
        gt=0.0,
        le=1.0,
        description="Largest ratio in Lowe's ratio test, among candidates that satisfy the epipolar constraint.",
    )
    max_distance: float = Field(
        default=0.7, gt=0.0, le=2.0, description="Largest L2 distance between matched unit-length descriptors."
    )
    max_reprojection_error: float = Field(
        default=1.5, gt=0.0, description="Largest reprojection error of an observation, pixels."
    )
    min_angle: float = Field(
        default=0.5,
        gt=0.0,
        lt=90.0,
        description="Least triangulation angle of a point, degrees. A colonoscope moves along its optical axis, where "
        "COLMAP's default of 1.5 leaves few points.",
    )
    min_track_length: int = Field(default=3, ge=2, description="Least number of frames that observe a point.")
    max_depth_uncertainty: float = Field(
        default=0.03,
        gt=0.0,
        description="Largest standard deviation of a point's z-depth, relative to it, propagated from the noise of the "
        "observations and the point's own residuals.",
    )
    max_lamp_difference: float = Field(
        default=4.0,
        gt=0.0,
        description="Largest difference of a point's log depth from that of points as bright, robust standard "
        "deviations: near a lamp at the lens, the wall is brighter.",
    )
    max_neighbour_difference: float = Field(
        default=0.1,
        gt=0.0,
        description="Largest difference of a point's log depth from four of its eight nearest neighbours in the image.",
    )
    min_share: float = Field(
        default=0.01,
        ge=0.0,
        le=1.0,
        description="Least share of triangulated points that pass the filters; fewer are an error. With correct poses "
        "it is a tenth to a half; with wrong ones less than a hundredth.",
    )
    seed: int = Field(default=0, ge=0, description="Seed of COLMAP's random samples.")


@dataclass(frozen=True, eq=False)
class Observations:
    """Observations of triangulated points in one frame."""

    pixels: Float[np.ndarray, "K 2"]  # observed column and row, pixel centres at integers + 0.5
    depth: Float[np.ndarray, "K"]  # z-depth of the points in this frame, scene units
    points: Int[np.ndarray, "K"]  # point indices


@dataclass(frozen=True, eq=False)
class Triangulation:
    """Triangulated surface points and their observations."""

    positions: Float[np.ndarray, "N 3"]  # world, scene units
    colors: UInt8[np.ndarray, "N 3"]  # RGB, mean over the observations
    errors: Float[np.ndarray, "N"]  # mean reprojection error, pixels
    depth_uncertainty: Float[np.ndarray, "N"]  # standard deviation of z-depth relative to it, mean over the frames
    track_lengths: Int[np.ndarray, "N"]  # number of frames that observe the point
    observations: tuple[Observations, ...]  # of each frame
    pixel_noise: float  # standard deviation of an observation along each axis, from the residuals, pixels
    matches: int  # number of feature matches over all pairs of frames
    found: int  # number of points before filtering

    def __len__(self) -> int:
        """Number of points."""
        return len(self.positions)

    def summary(self) -> str:
        """One-line summary."""
        return (
            f"{len(self)} points of {self.found} found, seen in {self.track_lengths.mean():.1f} frames each, "
            f"mean reprojection error {self.errors.mean():.2f} px, "
            f"median depth uncertainty {100.0 * np.median(self.depth_uncertainty):.1f} %"
        )


def triangulate(
    frames: Sequence[Frame], settings: TriangulationSettings | None = None, progress: Progress | None = None
) -> Triangulation:
    """Triangulate surface points by COLMAP with fixed poses and intrinsics; deterministic.

    SIFT features are matched along the epipolar lines of the given poses, joined into tracks and triangulated; points
    are filtered by track length, triangulation angle, reprojection error and depth uncertainty, and by their depth
    against the brightness (nearer is brighter under a lamp at the lens) and against neighbouring points.

    Args:
        frames: In video order; pinhole cameras, images of any size.
        settings: Default: for colonoscopy videos of some 300 to 800 pixels.
        progress: Progress callback.

    Raises:
        InputError: There are fewer than two frames, the camera does not move, or too few points are found, as with
            wrong poses.
    """
    settings = settings or TriangulationSettings()
    check_motion(frames, 2)
    with quiet_colmap(settings.seed):
        extract = feature_extractor(settings.features)
        features = [extract(*image_and_mask(frame)) for frame in with_progress(frames, "find features", progress)]
        exhaustive = len(frames) <= settings.exhaustive_up_to
        pairs = all_pairs(len(frames)) if exhaustive else video_pairs(len(frames), settings.overlap)
        limits = settings.max_epipolar_error, settings.max_ratio, settings.max_distance
        matches = {}
        for first, second in with_progress(pairs, "match features", progress):
            cameras = frames[first].camera, frames[second].camera
            matches[first, second] = epipolar_matches(features[first], features[second], cameras, *limits)
        count = sum(len(found) for found in matches.values())
        counts = [len(found) for found in features]
        log.info("%.0f features a frame, %d matches in %d pairs of frames", np.mean(counts), count, len(pairs))
        if not count:
            raise InputError(
                f"no features of {len(frames)} frames ({np.mean(counts):.0f} a frame) match along their epipolar lines",
                "overlapping frames with correct poses",
                "Check the poses (coliags data check), raise max_epipolar_error or lower features.peak_threshold",
            )
        model = _triangulated(frames, features, matches, settings)
    return _result(frames, Tracks.of(model, len(frames)), settings, count)


def _triangulated(
    frames: Sequence[Frame], features: Sequence[Features], matches: Matches, settings: TriangulationSettings
) -> pycolmap.Reconstruction:
    """The frames' model with points; the settings' reprojection error replaces COLMAP's pixel tolerances."""
    import pycolmap

    options = pycolmap.IncrementalPipelineOptions()
    options.extract_colors = False
    options.min_num_matches = 1
    options.random_seed = settings.seed
    options.mapper.filter_max_reproj_error = settings.max_reprojection_error
    options.mapper.filter_min_tri_angle = settings.min_angle
    pixels, shortest_focal = settings.max_reprojection_error, min(frame.camera.fx for frame in frames)
    triangulation = options.triangulation
    triangulation.random_seed = settings.seed
    triangulation.min_angle = settings.min_angle
    triangulation.ignore_two_view_tracks = False
    triangulation.merge_max_reproj_error = triangulation.complete_max_reproj_error = pixels
    degrees = float(np.degrees(np.arctan(pixels / shortest_focal)))
    triangulation.create_max_angle_error = triangulation.continue_max_angle_error = degrees
    model = frame_model(frames)
    images = [(model.images[number].name, model.images[number].camera_id - 1) for number in sorted(model.images)]
    cameras = [model.cameras[number] for number in sorted(model.cameras)]
    with tempfile.TemporaryDirectory() as scratch:
        database, output = Path(scratch) / "database.db", Path(scratch) / "model"
        output.mkdir()
        keypoints = [one.keypoints for one in features]
        write_database(database, cameras, images, keypoints, matches, verified=True)
        return pycolmap.triangulate_points(model, str(database), scratch, str(output), True, options, False)


def _result(frames: Sequence[Frame], tracks: Tracks, settings: TriangulationSettings, matches: int) -> Triangulation:
    found = len(tracks)
    cameras = [frame.camera.to("cpu") for frame in frames]
    tracks = tracks.only(tracks.lengths >= settings.min_track_length)
    tracks = tracks.only(widest_angles(tracks, cameras) >= settings.min_angle)
    seen = len(tracks)
    noise, shares = uncertainty(tracks, cameras)
    certain = shares <= settings.max_depth_uncertainty
    tracks, shares = tracks.only(certain), shares[certain]
    kept = fitting(frames, tracks, settings)
    if kept.sum() < max(FEWEST_POINTS, settings.min_share * found):
        raise InputError(
            f"of {found} points from {matches} matches, {seen} are seen in {settings.min_track_length} "
            f"frames or more at an angle of {settings.min_angle:g} degrees or more, {len(tracks)} of these have "
            f"a depth uncertainty of {100.0 * settings.max_depth_uncertainty:g} % or less, and {kept.sum()} of "
            "these are as deep as their neighbours",
            f"at least {FEWEST_POINTS}, and {100.0 * settings.min_share:g} % of the points found",
            "Check the poses first (coliags data check); else take frames farther apart, lower min_track_length, or "
            "raise max_depth_uncertainty, max_reprojection_error or max_neighbour_difference",
        )
    tracks, shares = tracks.only(kept), shares[kept]
    residuals, depth = tracks.residuals(cameras)
    lengths = tracks.lengths
    by_frame = [tracks.frames == index for index in range(len(frames))]
    observations = tuple(Observations(tracks.pixels[here], depth[here], tracks.points[here]) for here in by_frame)
    errors = np.bincount(tracks.points, np.linalg.norm(residuals, axis=1), len(tracks)) / lengths
    colors = _colors(frames, tracks)
    return Triangulation(tracks.positions, colors, errors, shares, lengths, observations, noise, matches, found)


def fitting(frames: Sequence[Frame], tracks: Tracks, settings: TriangulationSettings) -> Bool[np.ndarray, "N"]:
    """Points whose depth agrees with the lamp and, in most frames, with their neighbours that do."""
    _, depth = tracks.residuals([frame.camera.to("cpu") for frame in frames])
    log_depth = np.log(np.maximum(depth, np.finfo(float).tiny))
    brightness, differences = np.empty(len(depth)), np.empty(len(depth))
    by_frame = [tracks.frames == index for index in range(len(frames))]
    for frame, here in zip(frames, by_frame, strict=True):
        brightness[here] = brightness_at(frame.image.cpu().numpy(), tracks.pixels[here])
    from_lamp = difference_from_lamp(brightness, log_depth, tracks.frames)
    lit = median_of_points(from_lamp, tracks.points, len(tracks)) <= settings.max_lamp_difference
    for here in by_frame:
        left = here & lit[tracks.points]
        differences[left] = difference_from_neighbours(tracks.pixels[left], log_depth[left])
    differences[~lit[tracks.points]] = np.inf
    return median_of_points(differences, tracks.points, len(tracks)) <= settings.max_neighbour_difference


def _colors(frames: Sequence[Frame], tracks: Tracks) -> UInt8[np.ndarray, "N 3"]:
    total = np.zeros((len(tracks), 3))
    for index, frame in enumerate(frames):
        here = tracks.frames == index
        if here.any():
            column, row = tracks.pixels[here].astype(np.int64).T
            image = frame.image.cpu().numpy()
            colors = image[np.clip(row, 0, image.shape[0] - 1), np.clip(column, 0, image.shape[1] - 1)]
            np.add.at(total, tracks.points[here], colors)
    return np.asarray(np.rint(total / tracks.lengths[:, None]), np.uint8)


def in_pixels_of(triangulation: Triangulation, detected: Sequence[Frame], frames: Sequence[Frame]) -> Triangulation:
    """The same points, with pixels, errors and noise those of ``frames``, the detected ones at another size."""
    names = [[frame.name for frame in video] for video in (detected, frames)]
    if names[0] != names[1] or len(triangulation.observations) != len(frames):
        raise InputError(f"{len(detected)} and {len(frames)} frames", "the same frames at two sizes")
    observations, factors = [], []
    errors = np.zeros(len(triangulation))
    for observed, stored, frame in zip(triangulation.observations, detected, frames, strict=True):
        factor = np.array([frame.camera.width / stored.camera.width, frame.camera.height / stored.camera.height])
        pixels = observed.pixels * factor
        projected, _ = frame.camera.to("cpu", torch.float64).project(
            torch.from_numpy(triangulation.positions[observed.points])
        )
        np.add.at(errors, observed.points, np.linalg.norm(projected.numpy() - pixels, axis=1))
        observations.append(Observations(pixels, observed.depth, observed.points))
        factors.append(float(np.sqrt(factor.prod())))
    return replace(
        triangulation,
        observations=tuple(observations),
        errors=errors / triangulation.track_lengths,
        pixel_noise=triangulation.pixel_noise * float(np.mean(factors)),
    )
