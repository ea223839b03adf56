"""A video's features and matches, and its models by mapping from a starting camera."""

from __future__ import annotations

import logging
import shutil
import tempfile
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from functools import cache
from operator import itemgetter
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Float, Float32, Int64

from coliags_plugin.core.errors import InputError
from coliags_plugin.core.images import has_alpha, tell_of_alpha
from coliags_plugin.core.jobs import Progress, with_progress
from coliags_plugin.reconstruction.structure.adjustment import TEST_EVERY
from coliags_plugin.reconstruction.structure.features import (
    Features,
    Matches,
    alike_pairs,
    epipolar_inliers,
    feature_extractor,
    mutual_matches,
)
from coliags_plugin.reconstruction.structure.image_files import Masks, file_names, is_repeated, mask_of, read_image
from coliags_plugin.reconstruction.structure.mapping import MAX_PAIR_ERROR, brightness_at, map_images, map_tracks
from coliags_plugin.reconstruction.structure.point_tracks import FramePoints, sharpness, track_points
from coliags_plugin.reconstruction.structure.sfm_settings import (
    Picture,
    SfmSettings,
    Start,
    candidate_cameras,
    has_known_camera,
    starting_cameras,
)

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
    picture: Picture | None = None  # that sizes, keypoints and tracks are of; None: whole images
    settings: SfmSettings = field(default_factory=SfmSettings)
    masks: Masks = None
    progress: Progress | None = None

    def search_part(self) -> MatchedVideo:
        """A few images around the middle, on which cameras are tried.

        Every second or fourth, if there are enough: these are matched like all (:func:`alike_pairs`).
        """
        count = self.settings.search_images
        step = next((step for step in (4, 2) if len(self.images) >= step * count), 1)
        first = max(0, (len(self.images) - (count - 1) * step - 1) // 2)
        chosen = list(range(first, len(self.images), step))[:count]
        row_of = {index: row for row, index in enumerate(chosen)}
        pick = itemgetter(*chosen)  # of two or more, so that it gives tuples
        matches = {
            (row_of[first_image], row_of[second_image]): pairs
            for (first_image, second_image), pairs in self.matches.items()
            if first_image in row_of and second_image in row_of
        }
        picked = {name: pick(getattr(self, name)) for name in ("images", "names", "sizes", "keypoints", "brightness")}
        return replace(self, **picked, matches=matches, progress=None)

    def mapped(self, start: Start) -> list[pycolmap.Reconstruction]:
        """Models by mapping with fixed intrinsics, the largest first."""
        models = []
        with tempfile.TemporaryDirectory() as scratch:
            database, folder = Path(scratch) / "database.db", Path(scratch) / "models"
            if not self.tracks:
                self._write_database(database, start, range(len(self.images)))
                return map_images(database, folder, self.settings, len(self.images), self.progress)
            followed = [frame.followed for frame in self.tracks]
            windows = cut_where_lost(followed, self.settings.tracks.longest_window)
            if len(windows) > 1:
                cuts = ", ".join(str(window.start) for window in windows[1:])
                log.info("the video is mapped in %d windows, cut before frames %s", len(windows), cuts)
            for window in with_progress(windows, "find poses", self.progress if len(windows) > 1 else None):
                self._write_database(database, start, window)
                models += map_tracks(database, folder, self.settings)
                database.unlink()
                shutil.rmtree(folder)
        return sorted(models, key=lambda model: -model.num_reg_images())

    def _write_database(self, path: Path, start: Start, frames: range) -> None:
        """Create a database of some frames, whose matches COLMAP has to verify.

        Image i gets COLMAP's image and frame ID i + 1, the camera of the k-th image size camera and rig ID k + 1.
        """
        import pycolmap

        cameras = starting_cameras(self.settings.camera, self.images, self.sizes, start)
        camera_ids = {size: number for number, size in enumerate(dict.fromkeys(self.sizes), start=1)}
        database = pycolmap.Database.open(str(path))
        try:
            for number, camera in enumerate(cameras, start=1):
                camera.camera_id = number
                database.write_camera(camera, use_camera_id=True)
                rig = pycolmap.Rig(rig_id=number)
                rig.add_ref_sensor(camera.sensor_id)
                database.write_rig(rig, use_rig_id=True)
            for index in frames:
                camera_id = camera_ids[self.sizes[index]]
                image = pycolmap.Image(name=self.names[index], camera_id=camera_id, image_id=index + 1)
                database.write_image(image, use_image_id=True)
                frame = pycolmap.Frame(frame_id=index + 1, rig_id=camera_id)
                frame.add_data_id(image.data_id)
                database.write_frame(frame, use_frame_id=True)
                database.write_keypoints(index + 1, np.ascontiguousarray(self.keypoints[index]))
            for (first, second), pairs in self.matches.items():
                if first in frames and second in frames and len(pairs):
                    database.write_matches(first + 1, second + 1, np.ascontiguousarray(pairs, np.uint32))
        finally:
            database.close()


def cut_where_lost(followed: Sequence[float], longest: int) -> list[range]:
    """Stretches of frames, no longer than ``longest``, cut before frames that show little of the frame before.

    ``followed`` says of each frame how much of that it shows.
    """
    counts, windows, uncut = np.asarray(followed), list[range](), [range(len(followed))]
    while uncut:
        window = uncut.pop()
        if len(window) <= longest:
            windows.append(window)
            continue
        # In the middle half, so that stretches are not shorter than a quarter of the longest.
        start, stop = window.start + len(window) // 4, window.start + 3 * len(window) // 4
        cut = start + int(np.argmin(counts[start:stop]))
        uncut += [range(window.start, cut), range(cut, window.stop)]
    return sorted(windows, key=lambda window: window.start)


def read_video(
    images: tuple[Path, ...], settings: SfmSettings, masks: Masks = None, progress: Progress | None = None
) -> MatchedVideo:
    """Match the images of a video, by tracks or by features; masks are False where a pixel is ignored.

    Tracks are of all images, features of at most ``features_at_most``.
    """
    # Before the minutes of matching: what cannot be read or repeats, and a camera that does not fit.
    images, sizes, picture = _looked_at(images, masks)
    starting_cameras(settings.camera, images, sizes, candidate_cameras(settings.camera, tracked=False)[0][0])
    if has_known_camera(settings.camera):
        picture = None
    extract = feature_extractor(settings.features)

    @cache
    def features_of(index: int) -> tuple[Features, Float[np.ndarray, "K"]]:
        image = read_image(images[index])
        features = extract(image, mask_of(images[index], masks))
        return features, brightness_at(image, features.pixels)

    video: MatchedVideo | None = None
    some = _sharpest(images, settings)
    if _needs_tracks([sizes[index] for index in some], some, settings, features_of):
        features_of.cache_clear()
        points = track_points(images, settings.tracks, masks, progress)
        if settings.matching == "tracks" or np.median([frame.followed for frame in points]) >= _FOLLOWED:
            video = _tracked(images, sizes, points)
        else:
            log.info("points cannot be followed from image to image: features are matched instead")
    if video is None:
        if len(some) < len(images):
            log.info("features of %d of %d images are matched", len(some), len(images))
        described = [features_of(index) for index in with_progress(some, "find features", progress)]
        features, brightness = zip(*described, strict=True)
        matches = {
            (first, second): mutual_matches(features[first], features[second], settings.max_ratio)
            for first, second in with_progress(alike_pairs(features, settings, progress), "match features", progress)
        }
        sharp_images, sharp_sizes = tuple(images[index] for index in some), tuple(sizes[index] for index in some)
        keypoints = tuple(image_features.keypoints for image_features in features)
        video = MatchedVideo(sharp_images, _named(sharp_images), sharp_sizes, keypoints, brightness, matches)
    if picture is not None:  # of one size: keypoints are those of the picture
        corner = np.array(picture.corner, np.float32)
        video = replace(
            video,
            sizes=(picture.size,) * len(video.images),
            keypoints=tuple(np.hstack([points[:, :2] - corner, points[:, 2:]]) for points in video.keypoints),
            tracks=tuple(replace(frame, pixels=frame.pixels - corner) for frame in video.tracks),
        )
    return replace(video, picture=picture, settings=settings, masks=masks, progress=progress)


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
    """True if points are to be tracked: as the settings say, or where neighbours have few features in common."""
    if settings.matching != "auto" or len(sizes) < _FEWEST_FRAMES or len(set(sizes)) > 1:
        return settings.matching == "tracks"
    strong = []
    for first in np.unique(np.linspace(0, len(sizes) - 2, _COMPARED).round().astype(int)).tolist():
        pair = [features_of(images[row])[0] for row in (first, first + 1)]
        matches = mutual_matches(pair[0], pair[1], settings.max_ratio)
        pixels_first, pixels_second = (
            features.pixels[rows] - 0.5 for features, rows in zip(pair, matches.T, strict=True)
        )
        inliers = epipolar_inliers(pixels_first, pixels_second, sizes[first][::-1], MAX_PAIR_ERROR)
        strong.append(int(inliers.sum()) >= _PLENTY)
    log.info("%d of %d pairs of neighbouring images have plenty of features in common", sum(strong), len(strong))
    return float(np.mean(strong)) < _MOST


def _looked_at(
    images: Sequence[Path], masks: Masks
) -> tuple[tuple[Path, ...], tuple[tuple[int, int], ...], Picture | None]:
    """Images without those that repeat the one before, their widths and heights, and the lens's picture in them."""
    distinct, sizes, repeated = list[Path](), list[tuple[int, int]](), list[str]()
    last, shown = None, None
    tell_of_alpha(images[0].parent, [has_alpha(path) for path in images])
    for path in images:
        image, mask = read_image(path), mask_of(path, masks)
        height, width = image.shape[:2]
        if mask is not None and mask.shape != (height, width):
            raise InputError(
                f"the mask of {path} is {mask.shape[1]} x {mask.shape[0]}, the image {width} x {height}",
                "a mask of the image's size",
            )
        if last is not None and is_repeated(last, image):
            repeated.append(path.name)
            continue
        distinct.append(path)
        sizes.append((width, height))
        last = image
        if mask is not None and (shown is None or shown.shape == mask.shape):
            shown = mask if shown is None else shown | mask
    if repeated:
        named = ", ".join([*repeated[:10], *(["..."] if len(repeated) > 10 else [])])
        log.warning("%d of %d images repeat the one before and are left out: %s", len(repeated), len(images), named)
    if len(distinct) < 2:
        raise InputError(
            f"all {len(images)} images show the same",
            "images from different camera positions",
            "Give another part of the video",
        )
    picture = None if last is None or shown is None or len(set(sizes)) > 1 else Picture.in_mask(shown, last)
    return tuple(distinct), tuple(sizes), picture


def _named(images: Sequence[Path]) -> tuple[str, ...]:
    """Names in the model, which sort in the order of the images."""
    names = file_names([path.stem for path in images], "")
    return tuple(f"{name}{path.suffix}" for name, path in zip(names, images, strict=True))


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
            _, rows, partner_rows = np.intersect1d(ids[first], ids[second], assume_unique=True, return_indices=True)
            if len(rows) >= _FEWEST_COMMON:
                matches[first, second] = np.stack([rows, partner_rows], axis=1).astype(np.uint32)
    keypoints = tuple(frame.pixels[rows] for frame, rows in zip(points, used, strict=True))
    brightness = tuple(frame.brightness[rows].astype(np.float64) for frame, rows in zip(points, used, strict=True))
    return MatchedVideo(images, _named(images), sizes, keypoints, brightness, matches, tuple(points), tuple(ids))
