"""A video's features and matches, and its models by mapping from a starting camera."""

from __future__ import annotations

import tempfile
from dataclasses import dataclass
from operator import itemgetter
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Float

from coliags_plugin.core.errors import InputError
from coliags_plugin.core.progress import Progress, with_progress
from coliags_plugin.reconstruction.structure.colmap_database import write_database
from coliags_plugin.reconstruction.structure.features import Features, feature_extractor
from coliags_plugin.reconstruction.structure.image_files import Masks, file_names, mask_of, read_image
from coliags_plugin.reconstruction.structure.mapping import brightness_at, map_images
from coliags_plugin.reconstruction.structure.matching import Matches, alike_pairs, mutual_matches
from coliags_plugin.reconstruction.structure.sfm_cameras import Start, starting_cameras, starts
from coliags_plugin.reconstruction.structure.sfm_settings import SfmSettings

if TYPE_CHECKING:
    import pycolmap


@dataclass(frozen=True, eq=False)
class MatchedVideo:
    """Images with features and matches, some or all of a video."""

    images: tuple[Path, ...]
    names: tuple[str, ...]  # in the model
    sizes: tuple[tuple[int, int], ...]  # width and height
    features: tuple[Features, ...]
    brightness: tuple[Float[np.ndarray, "K"], ...]  # at the features
    matches: Matches

    def middle(self, count: int) -> MatchedVideo:
        """At most ``count`` images around the middle: every second or fourth, if there are enough.

        These are matched like all (:func:`alike_pairs`).
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
            pick(self.images), pick(self.names), pick(self.sizes), pick(self.features), pick(self.brightness), matches
        )

    def mapped(self, settings: SfmSettings, start: Start, progress: Progress | None) -> list[pycolmap.Reconstruction]:
        """Models by mapping with fixed intrinsics, the largest first."""
        cameras = starting_cameras(settings.camera, self.images, self.sizes, start)
        kinds = list(dict.fromkeys(self.sizes))
        named = [(name, kinds.index(size)) for name, size in zip(self.names, self.sizes, strict=True)]
        with tempfile.TemporaryDirectory() as scratch:
            database = Path(scratch) / "database.db"
            write_database(database, cameras, named, self.features, self.matches, verified=False)
            return map_images(database, Path(scratch) / "models", settings, len(self.images), progress)


def read_video(
    images: tuple[Path, ...], settings: SfmSettings, masks: Masks = None, progress: Progress | None = None
) -> MatchedVideo:
    """Find and match the features of a video's images."""
    extract = feature_extractor(settings.features)
    features, sizes, brightness = [], [], []
    for path in with_progress(images, "find features", progress):
        image, mask = read_image(path), mask_of(path, masks)
        height, width = image.shape[:2]
        if mask is not None and mask.shape != (height, width):
            raise InputError(
                f"the mask of {path} is {mask.shape[1]} x {mask.shape[0]}, the image {width} x {height}",
                "a mask of the image's size",
            )
        features.append(extract(image, mask))
        brightness.append(brightness_at(image, features[-1].pixels))
        sizes.append((width, height))
    starting_cameras(settings.camera, images, sizes, starts(settings.camera)[0])
    pairs = alike_pairs(features, settings, progress)
    matches = {
        (first, second): mutual_matches(features[first], features[second], settings.max_ratio, settings.max_distance)
        for first, second in with_progress(pairs, "match features", progress)
    }
    names = file_names([path.stem for path in images], "")
    named = tuple(f"{name}{path.suffix}" for name, path in zip(names, images, strict=True))
    return MatchedVideo(images, named, tuple(sizes), tuple(features), tuple(brightness), matches)
