"""Surface points from pictures whose poses are known."""

from __future__ import annotations

import logging
import tempfile
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Float, Int, UInt8
from pydantic import Field

from coliags_plugin.core.errors import InputError
from coliags_plugin.core.progress import Progress
from coliags_plugin.core.scenes import Frame
from coliags_plugin.core.settings import Settings
from coliags_plugin.reconstruction.structure.colmap_database import write_database
from coliags_plugin.reconstruction.structure.colmap_model import frame_model
from coliags_plugin.reconstruction.structure.features import FeatureSettings, feature_extractor
from coliags_plugin.reconstruction.structure.matching import Pairs, all_pairs, epipolar_matches, video_pairs
from coliags_plugin.reconstruction.structure.quiet import quiet_colmap
from coliags_plugin.reconstruction.structure.tracks import Tracks, uncertainty, widest_angles

if TYPE_CHECKING:
    import pycolmap

log = logging.getLogger(__name__)

#: Fewer points are no result.
FEWEST_POINTS = 10


class TriangulationSettings(Settings):
    """How frames are matched and which points are kept. Pixels are those of the frames given."""

    features: FeatureSettings = FeatureSettings()
    """What is looked for in a picture."""
    overlap: int = Field(
        default=6,
        ge=1,
        description="Frames are matched with those 1 to this many places on, and 2, 4, 8, ..., 2^(this - 1) places on.",
    )
    exhaustive_up_to: int = Field(default=12, ge=0, description="So many frames or fewer are matched each with each.")
    max_epipolar_error: float = Field(
        default=1.5, gt=0.0, description="Pixels that a match may be off the epipolar geometry of the given poses."
    )
    max_ratio: float = Field(
        default=0.7, gt=0.0, le=1.0, description="Of a match's distance to that of the next best which the poses allow."
    )
    max_distance: float = Field(default=0.7, gt=0.0, le=2.0, description="Between matching descriptors of unit length.")
    max_reprojection_error: float = Field(default=1.5, gt=0.0, description="Pixels from an observation to its point.")
    min_angle: float = Field(
        default=0.5,
        gt=0.0,
        lt=90.0,
        description="Least angle between two of the rays that meet in a point, degrees. A colonoscope moves along its "
        "line of sight: COLMAP's own 1.5 leaves little.",
    )
    min_track_length: int = Field(default=3, ge=2, description="Frames that have to see a point.")
    max_depth_uncertainty: float = Field(
        default=0.03,
        gt=0.0,
        description="Largest standard deviation of a point's z-depth, as a share of it, that follows from the noise of "
        "the observations and where they were taken from.",
    )
    min_share: float = Field(
        default=0.01,
        ge=0.0,
        le=1.0,
        description="Least share of the points found that are kept. Under true poses it is a tenth to a half; chance "
        "matches under false ones leave less than a hundredth.",
    )
    seed: int = Field(default=0, ge=0, description="Of COLMAP's random samples.")


@dataclass(frozen=True, eq=False)
class Observations:
    """What one frame sees of the points.

    Attributes:
        pixels: Where they were seen; column and row, pixel centres at integers + 0.5. [K, 2]
        depth: z-depth of the points in this frame, scene units. [K]
        points: Which points. [K]
    """

    pixels: Float[np.ndarray, "K 2"]
    depth: Float[np.ndarray, "K"]
    points: Int[np.ndarray, "K"]


@dataclass(frozen=True, eq=False)
class Triangulation:
    """Points on the surface, and which frame saw them where.

    Attributes:
        positions: World, scene units. [N, 3]
        colors: RGB, mean over the frames that see the point. [N, 3]
        errors: Mean distance between a point's projections and its observations, pixels. [N]
        depth_uncertainty: Standard deviation of z-depth, as a share of it; mean over the observing frames. [N]
        track_lengths: Frames that see the point. [N]
        observations: Of each frame.
        pixel_noise: Standard deviation of an observation, pixels along each axis, that the residuals show.
        matches: How many pairs of features were matched, over all pairs of frames.
        found: How many points there were before the thin and the uncertain ones were left out.
    """

    positions: Float[np.ndarray, "N 3"]
    colors: UInt8[np.ndarray, "N 3"]
    errors: Float[np.ndarray, "N"]
    depth_uncertainty: Float[np.ndarray, "N"]
    track_lengths: Int[np.ndarray, "N"]
    observations: tuple[Observations, ...]
    pixel_noise: float
    matches: int
    found: int

    def __len__(self) -> int:
        """Number of points."""
        return len(self.positions)

    def summary(self) -> str:
        """What came out, in one line."""
        return (
            f"{len(self)} points of {self.found} found, seen in {self.track_lengths.mean():.1f} frames each, "
            f"mean reprojection error {self.errors.mean():.2f} px, "
            f"median depth uncertainty {100.0 * np.median(self.depth_uncertainty):.1f} %"
        )


def triangulate(
    frames: Sequence[Frame], settings: TriangulationSettings | None = None, progress: Progress | None = None
) -> Triangulation:
    """Find surface points by COLMAP's triangulation; poses and intrinsics stay as they are.

    SIFT features are matched along the epipolar lines of the given poses, joined to tracks and triangulated; points are
    kept that enough frames see, from far enough apart, with little enough left over. The same input gives the same
    points.

    Args:
        frames: In video order; pictures of pinhole cameras, of any sizes.
        settings: Default: those of a colonoscopy video of some 300 to 800 pixels.
        progress: Told how far it is.

    Raises:
        InputError: There are fewer than two frames, the camera does not move, or hardly any points are found, as under
            poses that are not the frames'.
    """
    settings = settings or TriangulationSettings()
    if len(frames) < 2:
        raise InputError(f"{len(frames)} frames", "two at least, from different places", "Give more of the video")
    centers = np.stack([frame.camera.center.cpu().double().numpy() for frame in frames])
    if not np.ptp(centers, axis=0).max() > 0.0:
        raise InputError(
            f"all {len(frames)} cameras are in one place",
            "poses from different places",
            "A camera that only turns shows no depth; check the poses",
        )
    with quiet_colmap(settings.seed):
        features = []
        extract = feature_extractor(settings.features)
        for done, frame in enumerate(frames, start=1):
            mask = frame.mask
            features.append(extract(frame.image.cpu().numpy(), None if mask is None else mask.cpu().numpy()))
            if progress is not None:
                progress("find features", done, len(frames))
        pairs = all_pairs(len(frames))
        if len(frames) > settings.exhaustive_up_to:
            pairs = video_pairs(len(frames), settings.overlap)
        matches: dict[tuple[int, int], Pairs] = {}
        for done, (first, second) in enumerate(pairs, start=1):
            matches[first, second] = epipolar_matches(
                features[first],
                features[second],
                (frames[first].camera, frames[second].camera),
                settings.max_epipolar_error,
                settings.max_ratio,
                settings.max_distance,
            )
            if progress is not None:
                progress("match features", done, len(pairs))
        count = sum(len(found) for found in matches.values())
        counts = [len(found) for found in features]
        log.info("%.0f features a frame, %d matches in %d pairs of frames", np.mean(counts), count, len(pairs))
        if not count:
            raise InputError(
                f"no features of {len(frames)} frames ({np.mean(counts):.0f} a frame) match along their epipolar lines",
                "frames that show the same surface, and their true poses",
                "Check the poses (coliags data check), or set max_epipolar_error higher or features.peak_threshold "
                "lower",
            )
        with tempfile.TemporaryDirectory() as scratch:
            database = Path(scratch) / "database.db"
            posed = frame_model(frames)
            images = [posed.images[number] for number in sorted(posed.images)]
            write_database(
                database,
                [posed.cameras[number] for number in sorted(posed.cameras)],
                [(image.name, image.camera_id - 1) for image in images],
                features,
                matches,
                verified=True,
            )
            model = _triangulated(posed, database, Path(scratch), frames, settings)
    return _result(frames, Tracks.of(model, len(frames)), settings, count)


def _triangulated(
    model: pycolmap.Reconstruction,
    database: Path,
    scratch: Path,
    frames: Sequence[Frame],
    settings: TriangulationSettings,
) -> pycolmap.Reconstruction:
    """The model with points. Every pixel tolerance of COLMAP's is the one of the settings."""
    import pycolmap

    options = pycolmap.IncrementalPipelineOptions()
    options.extract_colors = False
    options.min_num_matches = 1
    options.random_seed = settings.seed
    options.mapper.filter_max_reproj_error = settings.max_reprojection_error
    options.mapper.filter_min_tri_angle = settings.min_angle
    pixels, widest = settings.max_reprojection_error, min(frame.camera.fx for frame in frames)
    triangulation = options.triangulation
    triangulation.random_seed = settings.seed
    triangulation.min_angle = settings.min_angle
    triangulation.ignore_two_view_tracks = False
    triangulation.merge_max_reproj_error = triangulation.complete_max_reproj_error = pixels
    degrees = float(np.degrees(np.arctan(pixels / widest)))
    triangulation.create_max_angle_error = triangulation.continue_max_angle_error = degrees
    (scratch / "model").mkdir()
    return pycolmap.triangulate_points(model, str(database), str(scratch), str(scratch / "model"), True, options, False)


def _result(frames: Sequence[Frame], tracks: Tracks, settings: TriangulationSettings, matches: int) -> Triangulation:
    found = len(tracks)
    cameras = [frame.camera.to("cpu") for frame in frames]
    tracks = tracks.only(tracks.lengths >= settings.min_track_length)
    tracks = tracks.only(widest_angles(tracks, cameras) >= settings.min_angle)
    noise, shares = uncertainty(tracks, cameras)
    certain = shares <= settings.max_depth_uncertainty
    if certain.sum() < max(FEWEST_POINTS, settings.min_share * found):
        raise InputError(
            f"of {found} points that {matches} matches make, {len(tracks)} are seen in {settings.min_track_length} "
            f"frames or more under {settings.min_angle:g} degrees or more, and {certain.sum()} of these have a depth "
            f"that is certain to {100.0 * settings.max_depth_uncertainty:g} %",
            f"{FEWEST_POINTS} at least, and {100.0 * settings.min_share:g} % of those found",
            "Check the poses first (coliags data check); else take frames farther apart, or set min_track_length "
            "lower, or max_depth_uncertainty or max_reprojection_error higher",
        )
    tracks, shares = tracks.only(certain), shares[certain]
    residuals, depth = tracks.residuals(cameras)
    lengths = tracks.lengths
    observations = []
    for index in range(len(frames)):
        here = tracks.frames == index
        observations.append(Observations(tracks.pixels[here], depth[here], tracks.points[here]))
    return Triangulation(
        tracks.positions,
        _colors(frames, tracks),
        np.bincount(tracks.points, np.linalg.norm(residuals, axis=1), len(tracks)) / lengths,
        shares,
        lengths,
        tuple(observations),
        noise,
        matches,
        found,
    )


def _colors(frames: Sequence[Frame], tracks: Tracks) -> UInt8[np.ndarray, "N 3"]:
    total = np.zeros((len(tracks), 3))
    for index, frame in enumerate(frames):
        here = tracks.frames == index
        if here.any():
            column, row = tracks.pixels[here].astype(np.int64).T
            image = frame.image.cpu().numpy()
            seen = image[np.clip(row, 0, image.shape[0] - 1), np.clip(column, 0, image.shape[1] - 1)]
            np.add.at(total, tracks.points[here], seen)
    return np.asarray(np.rint(total / tracks.lengths[:, None]), np.uint8)
