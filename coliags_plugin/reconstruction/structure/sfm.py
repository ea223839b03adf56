"""Incremental structure from motion by COLMAP: camera poses, intrinsics and points from images."""

from __future__ import annotations

import logging
import shutil
import tempfile
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Bool, Float
from pydantic import Field

from coliags_plugin.core.errors import InputError
from coliags_plugin.core.files import atomic_folder
from coliags_plugin.core.images import write_mask
from coliags_plugin.core.progress import Progress
from coliags_plugin.core.settings import Settings
from coliags_plugin.datamanagers.colmap.writer import write_model
from coliags_plugin.poses.rigid import inverse
from coliags_plugin.poses.trajectory import Trajectory
from coliags_plugin.reconstruction.structure.colmap_database import write_database
from coliags_plugin.reconstruction.structure.features import Features, FeatureSettings, feature_extractor
from coliags_plugin.reconstruction.structure.image_files import file_names, read_image, read_mask
from coliags_plugin.reconstruction.structure.matching import Pairs, all_pairs, mutual_matches, video_pairs
from coliags_plugin.reconstruction.structure.quiet import quiet_colmap

if TYPE_CHECKING:
    import pycolmap

log = logging.getLogger(__name__)

#: A focal length that changes by more than this factor during refinement is warned about.
_FOCAL_DRIFT = 2.0


class CameraSettings(Settings):
    """Camera model and initial intrinsics, shared by all images."""

    model: str = Field(default="SIMPLE_RADIAL", description="COLMAP camera model, for instance OPENCV_FISHEYE.")
    params: tuple[float, ...] | None = Field(
        default=None,
        description="Its parameters, in COLMAP's order; pixels, pixel centres at integers + 0.5. None: estimated, "
        "starting from a focal length of focal_factor times the larger side.",
    )
    refine: bool | None = Field(
        default=None, description="Whether focal length and distortion are refined. None: if no parameters are given."
    )
    focal_factor: float = Field(
        default=0.75,
        gt=0.0,
        description="Initial focal length, relative to the image's larger side. Endoscopes have 0.5 to 1.",
    )

    @property
    def is_refined(self) -> bool:
        """Whether focal length and distortion are refined."""
        return self.params is None if self.refine is None else self.refine


class SfmSettings(Settings):
    """Options of matching and incremental mapping."""

    camera: CameraSettings = CameraSettings()
    """Camera model and initial intrinsics, shared by all images."""
    features: FeatureSettings = FeatureSettings(max_features=6000, peak_threshold=0.002)
    """Feature extraction."""
    overlap: int = Field(
        default=8,
        ge=1,
        description="Sequential matching: each image with the next 1, 2, ..., overlap images, and with those 2, 4, "
        "..., 2^(overlap - 1) images ahead.",
    )
    exhaustive_up_to: int = Field(default=25, ge=0, description="Up to this many images are matched exhaustively.")
    max_ratio: float = Field(default=0.8, gt=0.0, le=1.0, description="Largest ratio in Lowe's ratio test.")
    max_distance: float = Field(
        default=0.7, gt=0.0, le=2.0, description="Largest L2 distance between matched unit-length descriptors."
    )
    max_error: float = Field(
        default=4.0, gt=0.0, description="RANSAC inlier threshold of two-view geometric verification, pixels."
    )
    min_model_size: int = Field(default=3, ge=2, description="Least number of registered images of a model.")
    seed: int = Field(default=0, ge=0, description="Seed of COLMAP's random samples.")


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
    """

    images: tuple[Path, ...]
    registered: tuple[int, ...]
    camera_to_world: Float[np.ndarray, "M 4 4"]
    names: tuple[str, ...]
    model: pycolmap.Reconstruction
    models: tuple[int, ...]

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
        depths = []
        for index in self.registered:
            image = self.model.images[index + 1]
            seen = [self.model.points3D[point.point3D_id].xyz for point in image.get_observation_points2D()]
            depths.append(np.array(seen).reshape(-1, 3) @ image.cam_from_world().matrix()[2, :3])
            depths[-1] += image.cam_from_world().matrix()[2, 3]
        return float(np.median(np.concatenate(depths)))

    def summary(self) -> str:
        """One-line summary."""
        camera, *others = (self.model.cameras[number] for number in sorted(self.model.cameras))
        return (
            f"{len(self.registered)} of {len(self.images)} images posed, {self.model.num_points3D()} points, mean "
            f"reprojection error {self.model.compute_mean_reprojection_error():.2f} px, {camera.model_name} "
            f"{', '.join(f'{value:.5g}' for value in camera.params)}"
            f"{f' and {len(others)} further cameras' if others else ''}"
        )


def reconstruct(
    images: Sequence[Path],
    settings: SfmSettings | None = None,
    masks: Mapping[Path, Bool[np.ndarray, "H W"]] | Bool[np.ndarray, "H W"] | None = None,
    progress: Progress | None = None,
) -> Reconstruction:
    """Estimate poses and points by incremental structure from motion, and return the largest model.

    Args:
        images: Files in video order. Images of the same size share a camera.
        settings: Default: unknown intrinsics.
        masks: False where a pixel is ignored; one for all images, or one per image.
        progress: Progress callback.

    Raises:
        InputError: There are fewer than two images, one cannot be read, sizes differ where parameters are given, the
            camera model is unknown, or no model is found.
    """
    settings = settings or SfmSettings()
    images = tuple(images)
    if len(images) < 2:
        raise InputError(f"{len(images)} images", "at least two", "Give more of the video")
    with quiet_colmap(settings.seed):
        features, sizes = _features(images, settings, masks, progress)
        cameras = _cameras(settings.camera, images, sizes)
        kinds = list(dict.fromkeys(sizes))
        matches = _matches(features, settings, progress)
        names = file_names([path.stem for path in images], "")
        names = [f"{name}{path.suffix}" for name, path in zip(names, images, strict=True)]
        with tempfile.TemporaryDirectory() as scratch:
            database = Path(scratch) / "database.db"
            named = [(name, kinds.index(size)) for name, size in zip(names, sizes, strict=True)]
            write_database(database, cameras, named, features, matches, verified=False)
            models = _map(database, Path(scratch), settings, len(images), progress)
    counts = [len(found) for found in features]
    if not models:
        raise InputError(
            f"no model from {len(images)} images with {np.mean(counts):.0f} features and "
            f"{np.mean([len(pairs) for pairs in matches.values()]):.0f} matches a pair",
            "overlapping images from different camera positions",
            "Take frames farther apart (the camera has to move) or closer together (they have to overlap), give the "
            "camera parameters if known, mask what does not move with the scene, or raise max_ratio",
        )
    found = _result(images, names, models)
    if settings.camera.is_refined:
        _warn_of_focal_drift(found, settings.camera)
    return found


def write_sfm_scene(
    folder: Path,
    found: Reconstruction,
    masks: Mapping[Path, Bool[np.ndarray, "H W"]] | Bool[np.ndarray, "H W"] | None = None,
    overwrite: bool = False,
) -> None:
    """Write a scene in COLMAP's layout: copies of the registered images, masks and the model.

    Args:
        folder: The folder to create.
        found: From :func:`reconstruct`.
        masks: As for :func:`reconstruct`.
        overwrite: Replace the folder if it exists.

    Raises:
        InputError: The folder exists or cannot be written.
    """
    with atomic_folder(folder, overwrite) as scratch:
        (scratch / "images").mkdir()
        for index in found.registered:
            shutil.copyfile(found.images[index], scratch / "images" / found.names[index])
            mask = _mask_of(found.images[index], masks)
            if mask is not None:
                write_mask(scratch / "masks" / f"{found.names[index]}.png", mask)
        write_model(scratch, found.model)


def masks_for(path: Path, images: Sequence[Path]) -> Mapping[Path, np.ndarray] | np.ndarray:
    """Read one mask for all images from a file, or a mask per image from a folder.

    Args:
        path: A mask image, black where pixels are ignored; or a folder of ``NAME.png`` or ``NAME.jpg.png``.
        images: The images to find masks for.

    Raises:
        InputError: A mask is missing or cannot be read.
    """
    if path.is_file():
        return read_mask(path)
    masks = {}
    for image in images:
        candidates = (path / f"{image.name}.png", path / f"{image.stem}.png")
        file = next((candidate for candidate in candidates if candidate.is_file()), None)
        if file is None:
            raise InputError(
                f"{path} has no mask for {image.name}",
                f"{candidates[0].name} or {candidates[1].name}",
                "Give one mask for all images, or a folder with a mask for each",
            )
        masks[image] = read_mask(file)
    return masks


def _mask_of(image: Path, masks: Mapping[Path, np.ndarray] | np.ndarray | None) -> np.ndarray | None:
    return masks.get(image) if isinstance(masks, Mapping) else masks


def _cameras(
    settings: CameraSettings, images: Sequence[Path], sizes: Sequence[tuple[int, int]]
) -> list[pycolmap.Camera]:
    """One camera per image size, in order of first appearance."""
    import pycolmap

    known = {name for name in pycolmap.CameraModelId.__members__ if name != "INVALID"}
    if settings.model not in known:
        raise InputError(f"camera model {settings.model}", f"one of {', '.join(sorted(known))}")
    cameras = []
    for width, height in dict.fromkeys(sizes):
        focal = settings.focal_factor * max(width, height)
        camera = pycolmap.Camera.create_from_model_name(0, settings.model, focal, width, height)
        if settings.params is not None:
            if len(settings.params) != len(camera.params):
                raise InputError(
                    f"{len(settings.params)} parameters for {settings.model}",
                    f"{len(camera.params)}: {camera.params_info}",
                )
            camera.params = list(settings.params)
        # Also set for a guessed focal length: otherwise COLMAP estimates two-view geometry as uncalibrated, which is
        # ill-conditioned for blurred images under forward motion and wrong for a fisheye.
        camera.has_prior_focal_length = True
        cameras.append(camera)
    if settings.params is not None and len(cameras) > 1:
        other = next(index for index, size in enumerate(sizes) if size != sizes[0])
        raise InputError(
            f"{images[other].name} is {sizes[other][0]} x {sizes[other][1]}, {images[0].name} "
            f"{sizes[0][0]} x {sizes[0][1]}",
            "images of one size, since the parameters of one camera are given",
            "Leave out the images of other sizes",
        )
    return cameras


def _features(
    images: Sequence[Path],
    settings: SfmSettings,
    masks: Mapping[Path, np.ndarray] | np.ndarray | None,
    progress: Progress | None,
) -> tuple[list[Features], list[tuple[int, int]]]:
    """Features, and width and height, of every image."""
    extract = feature_extractor(settings.features)
    features, sizes = [], []
    for done, path in enumerate(images, start=1):
        image, mask = read_image(path), _mask_of(path, masks)
        height, width = image.shape[:2]
        if mask is not None and mask.shape != (height, width):
            raise InputError(
                f"the mask of {path} is {mask.shape[1]} x {mask.shape[0]}, the image {width} x {height}",
                "a mask of the image's size",
            )
        features.append(extract(image, mask))
        sizes.append((width, height))
        if progress is not None:
            progress("find features", done, len(images))
    return features, sizes


def _matches(
    features: Sequence[Features], settings: SfmSettings, progress: Progress | None
) -> dict[tuple[int, int], Pairs]:
    pairs = all_pairs(len(features))
    if len(features) > settings.exhaustive_up_to:
        pairs = video_pairs(len(features), settings.overlap)
    matches = {}
    for done, (first, second) in enumerate(pairs, start=1):
        matches[first, second] = mutual_matches(
            features[first], features[second], settings.max_ratio, settings.max_distance
        )
        if progress is not None:
            progress("match features", done, len(pairs))
    return matches


def _map(
    database: Path, scratch: Path, settings: SfmSettings, count: int, progress: Progress | None
) -> list[pycolmap.Reconstruction]:
    """COLMAP's models after geometric verification and mapping, the largest first.

    Intrinsics to be refined stay fixed until all images are registered and are refined by a final bundle adjustment:
    with few images, motion along the optical axis makes them diverge. Only if images remain unregistered, mapping is
    repeated with refinement from the start, and the larger model is returned.
    """
    import pycolmap

    views = pycolmap.TwoViewGeometryOptions()
    views.ransac.max_error = settings.max_error
    views.ransac.random_seed = settings.seed
    # The endoscope's dark border is masked instead of being detected as a watermark of static matches.
    views.detect_watermark = False
    pycolmap.geometric_verification(
        str(database), pycolmap.GeometricVerifierOptions(num_threads=1), two_view_geometry_options=views
    )
    found = _incremental_mapping(database, scratch / "fixed", settings, False, count, progress)
    if settings.camera.is_refined:
        for model in found[:1]:
            _bundle_adjust(model)
        if not found or found[0].num_reg_images() < count:
            other = _incremental_mapping(database, scratch / "refined", settings, True, count, progress)
            if other and (not found or other[0].num_reg_images() > found[0].num_reg_images()):
                return other
    return found


def _incremental_mapping(
    database: Path, scratch: Path, settings: SfmSettings, refines: bool, count: int, progress: Progress | None
) -> list[pycolmap.Reconstruction]:
    """Models of COLMAP's incremental mapping, the largest first, with or without refined intrinsics.

    Runs on one thread, so that the order of summation is fixed.
    """
    import pycolmap

    options = pycolmap.IncrementalPipelineOptions()
    options.num_threads = options.mapper.num_threads = 1
    options.random_seed = options.mapper.random_seed = options.triangulation.random_seed = settings.seed
    options.min_model_size = settings.min_model_size
    options.extract_colors = False
    options.ba_refine_focal_length = options.ba_refine_extra_params = refines
    options.mapper.abs_pose_refine_focal_length = options.mapper.abs_pose_refine_extra_params = refines
    scratch.mkdir()
    posed = 0

    def start() -> None:
        nonlocal posed
        posed = 1
        next_image()

    # The callback lets Python handle Ctrl-C.
    def next_image() -> None:
        nonlocal posed
        posed += 1
        if progress is not None:
            progress("find poses", min(posed, count), count)

    found = pycolmap.incremental_mapping(
        str(database),
        str(scratch),
        str(scratch),
        options,
        initial_image_pair_callback=start,
        next_image_callback=next_image,
    )
    return sorted(found.values(), key=lambda model: -model.num_reg_images())


def _bundle_adjust(model: pycolmap.Reconstruction) -> None:
    """Global bundle adjustment of intrinsics, poses and points, followed by point filtering; done twice."""
    import pycolmap

    options = pycolmap.BundleAdjustmentOptions()
    options.print_summary = False
    getattr(options, "ceres", options).solver_options.num_threads = 1
    mapper = pycolmap.IncrementalPipelineOptions().mapper
    for _ in range(2):
        # pycolmap.bundle_adjustment would do the same, but turns COLMAP's log on (4.2.1).
        whole = pycolmap.BundleAdjustmentConfig()
        for number in model.reg_image_ids():
            whole.add_image(number)
        whole.fix_gauge(pycolmap.BundleAdjustmentGauge.TWO_CAMS_FROM_WORLD)
        pycolmap.create_default_bundle_adjuster(options, whole, model).solve()
        pycolmap.ObservationManager(model).filter_all_points3D(
            mapper.filter_max_reproj_error, mapper.filter_min_tri_angle
        )
    model.update_point_3d_errors()


def _result(
    images: tuple[Path, ...], names: Sequence[str], models: Sequence[pycolmap.Reconstruction]
) -> Reconstruction:
    model = models[0]
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
    return found


def _warn_of_focal_drift(found: Reconstruction, settings: CameraSettings) -> None:
    for camera in found.model.cameras.values():
        now, start = camera.mean_focal_length(), settings.focal_factor * max(camera.width, camera.height)
        if settings.params is None and not 1.0 / _FOCAL_DRIFT < now / start < _FOCAL_DRIFT:
            log.warning(
                "the focal length went from %.0f to %.0f px: motion along the optical axis hardly constrains it, and "
                "a wrong one bends trajectory and surface. Give the camera's calibration if there is one, or a better "
                "initial value (camera.focal_factor)",
                start,
                now,
            )
            return


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
