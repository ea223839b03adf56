"""Incremental structure from motion by COLMAP: camera poses, intrinsics and points from images."""

from __future__ import annotations

import logging
import tempfile
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Float

from coliags_plugin.core.errors import InputError
from coliags_plugin.core.progress import Progress
from coliags_plugin.poses.rigid import inverse
from coliags_plugin.poses.trajectory import Trajectory
from coliags_plugin.reconstruction.structure.colmap_database import write_database
from coliags_plugin.reconstruction.structure.features import Features, feature_extractor
from coliags_plugin.reconstruction.structure.hypotheses import Hypothesis, choose, is_ambiguous, reversed_in_depth
from coliags_plugin.reconstruction.structure.image_files import Masks, file_names, mask_of, read_image
from coliags_plugin.reconstruction.structure.mapping import bundle_adjust, map_images
from coliags_plugin.reconstruction.structure.matching import Pairs, mutual_matches
from coliags_plugin.reconstruction.structure.observations import brightness_at, depths_of
from coliags_plugin.reconstruction.structure.pair_selection import alike_pairs
from coliags_plugin.reconstruction.structure.quiet import quiet_colmap
from coliags_plugin.reconstruction.structure.sfm_cameras import (
    field_of_view,
    has_known_camera,
    is_refined,
    starting_cameras,
)
from coliags_plugin.reconstruction.structure.sfm_settings import SfmSettings

if TYPE_CHECKING:
    import pycolmap

log = logging.getLogger(__name__)


@dataclass(frozen=True, eq=False)
class Reconstruction:
    """Result of structure from motion. Scale and world frame are arbitrary: images alone determine neither.

    Attributes:
        images: All input images, in order.
        registered: Indices of the registered images, ascending. [M]
        camera_to_world: Their poses, OpenCV axes. [M, 4, 4]
        names: Names of all images in the model.
        model: COLMAP's reconstruction.
        models: Number of registered images of every model found, the largest first.
        correlation: Of log brightness with log depth (:func:`brightness_correlation`); None: unknown.
    """

    images: tuple[Path, ...]
    registered: tuple[int, ...]
    camera_to_world: Float[np.ndarray, "M 4 4"]
    names: tuple[str, ...]
    model: pycolmap.Reconstruction
    models: tuple[int, ...]
    correlation: float | None = None

    @property
    def left_out(self) -> tuple[Path, ...]:
        """Images that were not registered."""
        known = set(self.registered)
        return tuple(path for index, path in enumerate(self.images) if index not in known)

    @property
    def trajectory(self) -> Trajectory:
        """Poses named by the images' file names."""
        return Trajectory(self.camera_to_world, names=tuple(self.images[index].name for index in self.registered))

    @property
    def median_depth(self) -> float:
        """Median z-depth of the points over all observations, in the model's unit."""
        return float(np.median(np.concatenate([depths for _, depths in depths_of(self.model).values()])))

    def summary(self) -> str:
        """One-line summary."""
        camera, *others = (self.model.cameras[number] for number in sorted(self.model.cameras))
        return (
            f"{len(self.registered)} of {len(self.images)} images posed, {self.model.num_points3D()} points, mean "
            f"reprojection error {self.model.compute_mean_reprojection_error():.2f} px, {camera.model_name} "
            f"{', '.join(f'{value:.5g}' for value in camera.params)}"
            f"{f' and {len(others)} further cameras' if others else ''}, "
            f"field of view {field_of_view(camera):.0f} degrees"
        )


@dataclass(frozen=True, eq=False)
class Video:
    """Images with features and matches, some or all of a video.

    Attributes:
        images: Files.
        names: Names in the model.
        sizes: Width and height of each.
        features: Of each.
        brightness: At the features of each.
        matches: By pair of indices.
    """

    images: tuple[Path, ...]
    names: tuple[str, ...]
    sizes: tuple[tuple[int, int], ...]
    features: tuple[Features, ...]
    brightness: tuple[Float[np.ndarray, "K"], ...]
    matches: Mapping[tuple[int, int], Pairs]

    def middle(self, count: int) -> Video:
        """At most ``count`` images around the middle: every second or fourth, if there are enough.

        These are matched like all (:func:`alike_pairs`).
        """
        step = next((step for step in (4, 2) if len(self.images) >= step * count), 1)
        first = max(0, (len(self.images) - (count - 1) * step - 1) // 2)
        kept = list(range(first, len(self.images), step))[:count]
        place = {index: row for row, index in enumerate(kept)}
        matches = {
            (place[one], place[other]): pairs
            for (one, other), pairs in self.matches.items()
            if one in place and other in place
        }
        return Video(
            tuple(self.images[index] for index in kept),
            tuple(self.names[index] for index in kept),
            tuple(self.sizes[index] for index in kept),
            tuple(self.features[index] for index in kept),
            tuple(self.brightness[index] for index in kept),
            matches,
        )

    def mapped(
        self, settings: SfmSettings, focal_factor: float, progress: Progress | None
    ) -> list[pycolmap.Reconstruction]:
        """Models by mapping with fixed intrinsics, the largest first."""
        cameras = starting_cameras(settings.camera, self.images, self.sizes, focal_factor)
        kinds = list(dict.fromkeys(self.sizes))
        named = [(name, kinds.index(size)) for name, size in zip(self.names, self.sizes, strict=True)]
        with tempfile.TemporaryDirectory() as scratch:
            database = Path(scratch) / "database.db"
            write_database(database, cameras, named, self.features, self.matches, verified=False)
            return map_images(database, Path(scratch) / "models", settings, len(self.images), progress)


def reconstruct(
    images: Sequence[Path],
    settings: SfmSettings | None = None,
    masks: Masks = None,
    progress: Progress | None = None,
) -> Reconstruction:
    """Estimate poses and points by incremental structure from motion, and return the largest model.

    An unknown focal length is chosen on a part of the video: models from several initial values, and their reversals in
    depth, are bundle-adjusted and compared (:func:`~coliags_plugin.reconstruction.structure.hypotheses.choose`).

    Args:
        images: Files in video order. Images of the same size share a camera.
        settings: Default: unknown intrinsics.
        masks: False where a pixel is ignored; one for all images, or one per image.
        progress: Progress callback.

    Raises:
        InputError: There are fewer than two images, one cannot be read, sizes differ where parameters are given, the
            camera model is unknown, no model is found, or its focal length is implausible.
    """
    settings = settings or SfmSettings()
    images = tuple(images)
    if len(images) < 2:
        raise InputError(f"{len(images)} images", "at least two", "Give more of the video")
    with quiet_colmap(settings.seed):
        video = _video(images, settings, masks, progress)
        focal_factor = settings.camera.focal_factors[0]
        if not has_known_camera(settings.camera):
            focal_factor = _best_focal_factor(video, settings, focal_factor, progress)
        models = video.mapped(settings, focal_factor, progress)
        if not models:
            counts = [len(found) for found in video.features]
            raise InputError(
                f"no model from {len(images)} images with {np.mean(counts):.0f} features and "
                f"{np.mean([len(pairs) for pairs in video.matches.values()]):.0f} matches a pair",
                "overlapping images from different camera positions",
                "Take frames farther apart (the camera has to move) or closer together (they have to overlap), give "
                "the camera parameters if known, mask what does not move with the scene, or raise max_ratio",
            )
        return _result(images, video.names, _adjusted(models[0], video, settings), models)


def _video(images: tuple[Path, ...], settings: SfmSettings, masks: Masks, progress: Progress | None) -> Video:
    extract = feature_extractor(settings.features)
    features, sizes, brightness = [], [], []
    for done, path in enumerate(images, start=1):
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
        if progress is not None:
            progress("find features", done, len(images))
    starting_cameras(settings.camera, images, sizes, settings.camera.focal_factors[0])
    pairs = alike_pairs(features, settings, progress)
    matches = {}
    for done, (first, second) in enumerate(pairs, start=1):
        matches[first, second] = mutual_matches(
            features[first], features[second], settings.max_ratio, settings.max_distance
        )
        if progress is not None:
            progress("match features", done, len(pairs))
    names = file_names([path.stem for path in images], "")
    named = tuple(f"{name}{path.suffix}" for name, path in zip(names, images, strict=True))
    return Video(images, named, tuple(sizes), tuple(features), tuple(brightness), matches)


def _best_focal_factor(video: Video, settings: SfmSettings, default: float, progress: Progress | None) -> float:
    """Focal length to start from, relative to the larger side, from models of the middle of the video."""
    refined = is_refined(settings.camera)
    if len(settings.camera.focal_factors) == 1:
        return default
    part = video.middle(settings.search_images)
    hypotheses = []
    for done, factor in enumerate(settings.camera.focal_factors, start=1):
        for model in part.mapped(settings, factor, None)[:1]:
            hypotheses += _both_signs(model, part, refined)
        if progress is not None:
            progress("try focal lengths", done, len(settings.camera.focal_factors))
    try:
        chosen = choose(hypotheses, settings.camera.field_of_view)
    except InputError:
        return default
    if is_ambiguous(hypotheses, chosen, settings.camera.field_of_view):
        log.warning(
            "the images hardly determine the focal length, and a wrong one distorts path and surface: give the "
            "camera's calibration (--camera, --params) if there is one, or --camera SIMPLE_RADIAL_FISHEYE for a "
            "wide-angle lens"
        )
    camera = next(iter(chosen.model.cameras.values()))
    return float(camera.mean_focal_length() / max(camera.width, camera.height))


def _adjusted(model: pycolmap.Reconstruction, video: Video, settings: SfmSettings) -> Hypothesis:
    """The model after refinement of the intrinsics, if they are; reversed in depth if the lamp says so."""
    refined = is_refined(settings.camera)
    hypotheses = _both_signs(model, video, refined)
    known = has_known_camera(settings.camera) and not refined
    return choose(hypotheses, (0.0, 180.0) if known else settings.camera.field_of_view)


def _both_signs(model: pycolmap.Reconstruction, video: Video, refined: bool) -> list[Hypothesis]:
    """The bundle-adjusted model, and its reversal in depth unless it is lit from the camera."""
    if refined:
        bundle_adjust(model, refine_camera=True)
    found = Hypothesis.of(model, video.brightness)
    if found.is_lit_from_the_camera:
        return [found]
    return [found, Hypothesis.of(reversed_in_depth(model, refined), video.brightness, is_reversed=True)]


def _result(
    images: tuple[Path, ...], names: Sequence[str], chosen: Hypothesis, models: Sequence[pycolmap.Reconstruction]
) -> Reconstruction:
    model = chosen.model
    registered = sorted(number - 1 for number in model.reg_image_ids())
    _color(model, images)
    world_to_camera = np.tile(np.eye(4), (len(registered), 1, 1))
    for row, index in enumerate(registered):
        world_to_camera[row, :3] = model.images[index + 1].cam_from_world().matrix()
    found = Reconstruction(
        images,
        tuple(registered),
        inverse(world_to_camera),
        tuple(names),
        model,
        tuple(other.num_reg_images() for other in models),
        chosen.correlation,
    )
    if found.left_out:
        shown = ", ".join(path.name for path in found.left_out[:10])
        log.warning(
            "%d of %d images have no pose: %s%s",
            len(found.left_out),
            len(images),
            shown,
            ", ..." if len(found.left_out) > 10 else "",
        )
        if len(models) > 1:
            log.warning("the models have %s images; the largest is used", ", ".join(map(str, found.models)))
    if not chosen.is_lit_from_the_camera:
        log.warning(
            "nearer points are not brighter (correlation of brightness with depth %s): the model may be reversed in "
            "depth, or the lamp is not at the lens. Give the camera's calibration, or other frames",
            "unknown" if chosen.correlation is None else f"{chosen.correlation:.2f}",
        )
    return found


def _color(model: pycolmap.Reconstruction, images: Sequence[Path]) -> None:
    """Set each point's colour to the mean over its observations."""
    total: dict[int, np.ndarray] = {}
    for number in sorted(model.reg_image_ids()):
        image = read_image(images[number - 1])
        for seen in model.images[number].get_observation_points2D():
            row, column = min(int(seen.y()), image.shape[0] - 1), min(int(seen.x()), image.shape[1] - 1)
            total[seen.point3D_id] = total.get(seen.point3D_id, 0.0) + image[row, column].astype(np.float64)
    for point, color in total.items():
        model.points3D[point].color = np.rint(color / model.points3D[point].track.length()).astype(np.uint8)
