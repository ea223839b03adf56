"""A video's features and matches, and its models by mapping from a starting camera."""

from __future__ import annotations

import logging
import shutil
import tempfile
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cache
from operator import itemgetter
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Bool, Float, Float32, Int64

from coliags_plugin.core.errors import InputError
from coliags_plugin.core.progress import Progress, with_progress
from coliags_plugin.reconstruction.structure.adjustment import TEST_EVERY
from coliags_plugin.reconstruction.structure.colmap_database import write_database
from coliags_plugin.reconstruction.structure.features import Features, feature_extractor
from coliags_plugin.reconstruction.structure.image_files import Masks, file_names, mask_of, read_image
from coliags_plugin.reconstruction.structure.mapping import brightness_at, map_images, map_tracks
from coliags_plugin.reconstruction.structure.matching import Matches, alike_pairs, mutual_matches
from coliags_plugin.reconstruction.structure.point_tracks import FramePoints, epipolar_inliers, track_points
from coliags_plugin.reconstruction.structure.sfm_cameras import Start, starting_cameras, starts
from coliags_plugin.reconstruction.structure.sfm_settings import SfmSettings
from coliags_plugin.reconstruction.structure.texture import sharpness

if TYPE_CHECKING:
    import pycolmap

log = logging.getLogger(__name__)


@dataclass(frozen=True, eq=False)
class MatchedVideo:
    """Images with features and matches, some or all of a video."""

    images: tuple[Path, ...]
    names: tuple[str, ...]  # in the model
    sizes: tuple[tuple[int, int], ...]  # width and height
    keypoints: tuple[Float32[np.ndarray, "K D"], ...]
    brightness: tuple[Float[np.ndarray, "K"], ...]  # at the keypoints
    matches: Matches
    tracks: tuple[FramePoints, ...] = ()  # of each image, where matches are of tracks
    track_ids: tuple[Int64[np.ndarray, "K"], ...] = ()  # of the keypoints, where matches are of tracks

    def search_part(self, count: int) -> MatchedVideo:
        """At most ``count`` images around the middle, on which cameras are tried.

        Every second or fourth, if there are enough: these are matched like all (:func:`alike_pairs`).
        """
        step = next((step for step in (4, 2) if len(self.images) >= step * count), 1)
        first = max(0, (len(self.images) - (count - 1) * step - 1) // 2)
        kept = list(range(first, len(self.images), step))[:count]
        row_of = {index: row for row, index in enumerate(kept)}
        pick = itemgetter(*kept)  # of two or more, so that it gives tuples
        matches = {
            (row_of[one], row_of[other]): pairs
            for (one, other), pairs in self.matches.items()
            if one in row_of and other in row_of
        }
        return MatchedVideo(
            pick(self.images), pick(self.names), pick(self.sizes), pick(self.keypoints), pick(self.brightness), matches
        )

    def mapped(self, settings: SfmSettings, start: Start, progress: Progress | None) -> list[pycolmap.Reconstruction]:
        """Models by mapping with fixed intrinsics, the largest first."""
        cameras = starting_cameras(settings.camera, self.images, self.sizes, start)
        kinds = list(dict.fromkeys(self.sizes))
        named = [(name, kinds.index(size)) for name, size in zip(self.names, self.sizes, strict=True)]
        models = []
        with tempfile.TemporaryDirectory() as scratch:
            database, folder = Path(scratch) / "database.db", Path(scratch) / "models"
            if not self.tracks:
                write_database(database, cameras, named, self.keypoints, self.matches, verified=False)
                return map_images(database, folder, settings, len(self.images), progress)
            windows = self.windows(settings.tracks.longest_window)
            if len(windows) > 1:
                cuts = ", ".join(str(window.start) for window in windows[1:])
                log.info("the video is mapped in %d windows, cut before frames %s", len(windows), cuts)
            for window in with_progress(windows, "find poses", progress if len(windows) > 1 else None):
                frames = slice(window.start, window.stop)
                inside = {(i, j): pairs for (i, j), pairs in self.matches.items() if i in window and j in window}
                write_database(database, cameras, named[frames], self.keypoints[frames], inside, False, window.start)
                models += map_tracks(database, folder, settings)
                database.unlink()
                shutil.rmtree(folder)
        return sorted(models, key=lambda model: -model.num_reg_images())

    def windows(self, longest: int) -> list[range]:
        """Stretches of frames, each mapped by itself: cut where few points are followed, if longer than ``longest``."""
        followed = np.array([frame.followed for frame in self.tracks])
        done, left = [], [range(len(self.images))]
        while left:
            window = left.pop()
            if len(window) <= longest:
                done.append(window)
                continue
            # In the middle half, so that windows are not shorter than a quarter of the longest.
            start, stop = window.start + len(window) // 4, window.start + 3 * len(window) // 4
            cut = start + int(np.argmin(followed[start:stop]))
            left += [range(window.start, cut), range(cut, window.stop)]
        return sorted(done, key=lambda window: window.start)


def read_video(
    images: tuple[Path, ...], settings: SfmSettings, masks: Masks = None, progress: Progress | None = None
) -> MatchedVideo:
    """Match the images of a video, by tracks or by features; masks are False where a pixel is ignored.

    Tracks are of all images, features of at most ``features_at_most``.
    """
    # Before the minutes of matching: what cannot be read, and a camera that does not fit.
    sizes = tuple(_size(path, mask_of(path, masks)) for path in images)
    starting_cameras(settings.camera, images, sizes, starts(settings.camera)[0])
    extract = feature_extractor(settings.features)

    @cache
    def features_of(index: int) -> tuple[Features, Float[np.ndarray, "K"]]:
        image = read_image(images[index])
        features = extract(image, mask_of(images[index], masks))
        return features, brightness_at(image, features.pixels)

    some = _sharpest(images, settings)
    if _needs_tracks([sizes[index] for index in some], some, settings, features_of):
        features_of.cache_clear()
        points = track_points(images, settings.tracks, masks, progress)
        if settings.matching == "tracks" or np.median([frame.followed for frame in points]) >= _FOLLOWED:
            return _tracked(images, sizes, points)
        log.info("points cannot be followed from image to image: features are matched instead")
    if len(some) < len(images):
        log.info("features of %d of %d images are matched", len(some), len(images))
    taken, own = tuple(images[index] for index in some), tuple(sizes[index] for index in some)
    return _with_features(taken, own, settings, lambda row: features_of(some[row]), progress)


def _sharpest(images: Sequence[Path], settings: SfmSettings) -> list[int]:
    """Indices of the sharpest of every few images, so that features are matched of no more than are asked for."""
    import cv2

    step = -(-len(images) // settings.features_at_most)
    if step == 1 or settings.matching == "tracks":
        return list(range(len(images)))
    values = [sharpness(cv2.cvtColor(read_image(path), cv2.COLOR_RGB2GRAY)) for path in images]
    return [first + int(np.argmax(values[first : first + step])) for first in range(0, len(images), step)]


#: Features of an image by its index, and the brightness at them.
_FeaturesOf = Callable[[int], tuple[Features, Float[np.ndarray, "K"]]]
#: Neighbouring images compared at most; matches of plenty of features; and the share of the pairs that must have them.
_COMPARED, _PLENTY, _MOST = 24, 150, 0.9
#: Fewest images of a video; and of points that are followed from frame to frame, in the median.
_FEWEST_FRAMES, _FOLLOWED = 8, 60


def _needs_tracks(
    sizes: Sequence[tuple[int, int]], images: Sequence[int], settings: SfmSettings, features_of: _FeaturesOf
) -> bool:
    """Whether points are to be tracked: as the settings say, or where neighbours have few features in common."""
    if settings.matching != "auto" or len(sizes) < _FEWEST_FRAMES or len(set(sizes)) > 1:
        return settings.matching == "tracks"
    strong = []
    for first in np.unique(np.linspace(0, len(sizes) - 2, _COMPARED).round().astype(int)).tolist():
        pair = [features_of(images[row])[0] for row in (first, first + 1)]
        matches = mutual_matches(pair[0], pair[1], settings.max_ratio, settings.max_distance)
        one, other = (features.pixels[rows] - 0.5 for features, rows in zip(pair, matches.T, strict=True))
        inliers = epipolar_inliers(one, other, sizes[first][::-1], settings.max_error)
        strong.append(int(inliers.sum()) >= _PLENTY)
    log.info("%d of %d pairs of neighbouring images have plenty of features in common", sum(strong), len(strong))
    return float(np.mean(strong)) < _MOST


def _size(path: Path, mask: Bool[np.ndarray, "H W"] | None) -> tuple[int, int]:
    """Width and height of an image, the same as its mask's."""
    height, width = read_image(path).shape[:2]
    if mask is not None and mask.shape != (height, width):
        raise InputError(
            f"the mask of {path} is {mask.shape[1]} x {mask.shape[0]}, the image {width} x {height}",
            "a mask of the image's size",
        )
    return width, height


def _named(images: Sequence[Path]) -> tuple[str, ...]:
    """Names in the model, which sort in the order of the images."""
    names = file_names([path.stem for path in images], "")
    return tuple(f"{name}{path.suffix}" for name, path in zip(names, images, strict=True))


def _with_features(
    images: tuple[Path, ...],
    sizes: tuple[tuple[int, int], ...],
    settings: SfmSettings,
    features_of: _FeaturesOf,
    progress: Progress | None,
) -> MatchedVideo:
    features, brightness = zip(
        *(features_of(index) for index in with_progress(range(len(images)), "find features", progress)), strict=True
    )
    pairs = alike_pairs(features, settings, progress)
    matches = {
        (first, second): mutual_matches(features[first], features[second], settings.max_ratio, settings.max_distance)
        for first, second in with_progress(pairs, "match features", progress)
    }
    keypoints = tuple(one.keypoints for one in features)
    return MatchedVideo(images, _named(images), sizes, keypoints, brightness, matches)


#: Frames apart whose common tracks are matches, and fewest of them.
_APART, _FEWEST_COMMON = (1, 2, 3, 4, 5, 6, 8, 10, 12, 16, 20, 24, 32, 40, 48, 64), 15
#: Fewest frames of a track that is used.
_LEAST_LENGTH = 3


def _tracked(
    images: tuple[Path, ...], sizes: tuple[tuple[int, int], ...], points: Sequence[FramePoints]
) -> MatchedVideo:
    lengths = np.bincount(np.concatenate([frame.ids for frame in points]))
    used = [(lengths[frame.ids] >= _LEAST_LENGTH) & (frame.ids % TEST_EVERY > 0) for frame in points]
    ids = [frame.ids[rows] for frame, rows in zip(points, used, strict=True)]
    matches = {}
    for first in range(len(ids)):
        for second in (first + apart for apart in _APART if first + apart < len(ids)):
            _, one, other = np.intersect1d(ids[first], ids[second], assume_unique=True, return_indices=True)
            if len(one) >= _FEWEST_COMMON:
                matches[first, second] = np.stack([one, other], axis=1).astype(np.uint32)
    keypoints = tuple(frame.pixels[rows] for frame, rows in zip(points, used, strict=True))
    brightness = tuple(frame.brightness[rows].astype(np.float64) for frame, rows in zip(points, used, strict=True))
    return MatchedVideo(images, _named(images), sizes, keypoints, brightness, matches, tuple(points), tuple(ids))
