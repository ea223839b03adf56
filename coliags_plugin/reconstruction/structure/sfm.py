"""Incremental structure from motion by COLMAP: camera poses, intrinsics and points from images."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Float

from coliags_plugin.core.errors import InputError
from coliags_plugin.core.progress import Progress
from coliags_plugin.geometry.poses.rigid import inverse
from coliags_plugin.geometry.poses.trajectory import Trajectory
from coliags_plugin.reconstruction.libraries import quiet_colmap
from coliags_plugin.reconstruction.structure.hypotheses import Hypothesis, both_signs, choose, find_start
from coliags_plugin.reconstruction.structure.image_files import Masks, read_image
from coliags_plugin.reconstruction.structure.mapping import depths_of
from coliags_plugin.reconstruction.structure.sfm_cameras import field_of_view, has_known_camera, is_refined
from coliags_plugin.reconstruction.structure.sfm_settings import SfmSettings
from coliags_plugin.reconstruction.structure.video import MatchedVideo, read_video

if TYPE_CHECKING:
    import pycolmap

log = logging.getLogger(__name__)


@dataclass(frozen=True, eq=False)
class Reconstruction:
    """Result of structure from motion. Scale and world frame are arbitrary: images alone determine neither."""

    images: tuple[Path, ...]  # all input images, in order
    registered: tuple[int, ...]  # indices of the registered images, ascending
    camera_to_world: Float[np.ndarray, "M 4 4"]  # their poses, OpenCV axes
    names: tuple[str, ...]  # of all images in the model
    model: pycolmap.Reconstruction
    models: tuple[int, ...]  # number of registered images of every model found, the largest first
    correlation: float | None = None  # of log brightness with log depth; None: unknown

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


def reconstruct(
    images: Sequence[Path], settings: SfmSettings | None = None, masks: Masks = None, progress: Progress | None = None
) -> Reconstruction:
    """Estimate poses and points by incremental structure from motion, and return the largest model.

    An unknown camera's model and focal length are chosen on a part of the video (:func:`find_start`).

    Args:
        images: Files in video order. Images of the same size share a camera.
        settings: Default: unknown camera.
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
        video = read_video(images, settings, masks, progress)
        models = video.mapped(settings, find_start(video, settings, progress), progress)
        if not models:
            counts = [len(features) for features in video.features]
            raise InputError(
                f"no model from {len(images)} images with {np.mean(counts):.0f} features and "
                f"{np.mean([len(pairs) for pairs in video.matches.values()]):.0f} matches a pair",
                "overlapping images from different camera positions",
                "Take frames farther apart (the camera has to move) or closer together (they have to overlap), give "
                "the camera parameters if known, mask what does not move with the scene, or raise max_ratio",
            )
        refined = is_refined(settings.camera)
        known = has_known_camera(settings.camera) and not refined
        chosen = choose(both_signs(models[0], video, refined), (0.0, 180.0) if known else settings.camera.field_of_view)
        return _result(video, chosen, models)


def _result(video: MatchedVideo, chosen: Hypothesis, models: Sequence[pycolmap.Reconstruction]) -> Reconstruction:
    images, model = video.images, chosen.model
    registered = sorted(number - 1 for number in model.reg_image_ids())
    _color(model, images)
    world_to_camera = np.tile(np.eye(4), (len(registered), 1, 1))
    for row, index in enumerate(registered):
        world_to_camera[row, :3] = model.images[index + 1].cam_from_world().matrix()
    counts, poses = tuple(other.num_reg_images() for other in models), inverse(world_to_camera)
    reconstruction = Reconstruction(images, tuple(registered), poses, video.names, model, counts, chosen.correlation)
    if reconstruction.left_out:
        left_out = [path.name for path in reconstruction.left_out]
        shown = ", ".join([*left_out[:10], *(["..."] if len(left_out) > 10 else [])])
        log.warning("%d of %d images have no pose: %s", len(left_out), len(images), shown)
        if len(models) > 1:
            log.warning("the models have %s images; the largest is used", ", ".join(map(str, reconstruction.models)))
    if not chosen.is_lit_from_the_camera:
        log.warning(
            "nearer points are not brighter (correlation of brightness with depth %s): the model may be reversed in "
            "depth, or the lamp is not at the lens. Give the camera's calibration, or other frames",
            "unknown" if chosen.correlation is None else f"{chosen.correlation:.2f}",
        )
    return reconstruction


def _color(model: pycolmap.Reconstruction, images: Sequence[Path]) -> None:
    """Set each point's colour to the mean over its observations."""
    total: dict[int, np.ndarray] = {}
    for number in sorted(model.reg_image_ids()):
        image = read_image(images[number - 1])
        for observation in model.images[number].get_observation_points2D():
            row, column = min(int(observation.y()), image.shape[0] - 1), min(int(observation.x()), image.shape[1] - 1)
            color = image[row, column].astype(np.float64)
            total[observation.point3D_id] = total.get(observation.point3D_id, 0.0) + color
    for point, color in total.items():
        model.points3D[point].color = np.rint(color / model.points3D[point].track.length()).astype(np.uint8)
