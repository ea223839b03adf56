"""COLMAP's mapping and bundle adjustment, on one thread for determinism; observations of its models."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from jaxtyping import Float, Int, UInt8

from coliags_plugin.core.jobs import Progress
from coliags_plugin.reconstruction.structure.sfm_settings import SfmSettings

if TYPE_CHECKING:
    import pycolmap


#: RANSAC inlier thresholds of the two-view geometry by features, and of any two frames that tracks link, pixels.
MAX_PAIR_ERROR, _MAX_TRACK_ERROR = 4.0, 2.0


def _verify_pairs(database: Path, max_error: float, seed: int) -> None:
    import pycolmap

    views = pycolmap.TwoViewGeometryOptions()
    views.ransac.max_error = max_error
    views.ransac.random_seed = seed
    # The endoscope's dark border is masked instead of being detected as a watermark of static matches.
    views.detect_watermark = False
    pycolmap.geometric_verification(
        str(database), pycolmap.GeometricVerifierOptions(num_threads=1), two_view_geometry_options=views
    )


def map_tracks(database: Path, scratch: Path, settings: SfmSettings) -> list[pycolmap.Reconstruction]:
    """Models of verified matches by global mapping with fixed intrinsics, the largest first.

    All rotations are averaged, then all positions found at once: small motion between frames does not add up.
    """
    import pycolmap

    _verify_pairs(database, _MAX_TRACK_ERROR, settings.seed)
    options = pycolmap.GlobalPipelineOptions()
    options.min_model_size = settings.min_model_size
    mapper = options.mapper
    options.num_threads = mapper.num_threads = 1
    parts = mapper.retriangulation, mapper.global_positioning, mapper.rotation_averaging
    for seeded in (options, mapper, *parts):
        seeded.random_seed = settings.seed
    mapper.global_positioning.use_gpu = mapper.bundle_adjustment.ceres.use_gpu = False
    mapper.bundle_adjustment.refine_focal_length = mapper.bundle_adjustment.refine_extra_params = False
    scratch.mkdir()
    models = pycolmap.global_mapping(str(database), str(scratch), str(scratch), options)
    return sorted(models.values(), key=lambda model: -model.num_reg_images())


def map_images(
    database: Path, scratch: Path, settings: SfmSettings, count: int, progress: Progress | None
) -> list[pycolmap.Reconstruction]:
    """Models of verified matches by incremental mapping with fixed intrinsics, the largest first.

    Intrinsics that are to be refined stay fixed until all images are registered (:func:`bundle_adjust`): with few
    images, motion along the optical axis makes them diverge. ``count``, the number of images, is for the progress.
    """
    import pycolmap

    _verify_pairs(database, MAX_PAIR_ERROR, settings.seed)
    options = pycolmap.IncrementalPipelineOptions()
    options.num_threads = options.mapper.num_threads = 1
    options.random_seed = options.mapper.random_seed = options.triangulation.random_seed = settings.seed
    options.min_model_size = settings.min_model_size
    options.extract_colors = False
    options.ba_refine_focal_length = options.ba_refine_extra_params = False
    options.mapper.abs_pose_refine_focal_length = options.mapper.abs_pose_refine_extra_params = False
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

    models = pycolmap.incremental_mapping(
        str(database),
        str(scratch),
        str(scratch),
        options,
        initial_image_pair_callback=start,
        next_image_callback=next_image,
    )
    return sorted(models.values(), key=lambda model: -model.num_reg_images())


def bundle_adjust(model: pycolmap.Reconstruction, refine_camera: bool) -> None:
    """Global bundle adjustment of poses, points and, if refined, intrinsics, then point filtering; twice, in place."""
    import pycolmap

    mapper = pycolmap.IncrementalPipelineOptions().mapper
    for _ in range(2):
        solve_bundle(model, refine_camera)
        pycolmap.ObservationManager(model).filter_all_points3D(
            mapper.filter_max_reproj_error, mapper.filter_min_tri_angle
        )
    model.update_point_3d_errors()


def solve_bundle(
    model: pycolmap.Reconstruction,
    refine_camera: bool,
    robust_scale: float | None = None,
    max_iterations: int | None = None,
) -> None:
    """Adjust all poses and points of a model once, in place.

    By squared errors, or with ``robust_scale`` by Cauchy's cost, which is logarithmic above that error, pixels.
    ``max_iterations``: None for COLMAP's default.
    """
    import pycolmap

    options: Any = pycolmap.BundleAdjustmentOptions()
    options.print_summary = False
    options.refine_focal_length = options.refine_extra_params = refine_camera
    ceres = getattr(options, "ceres", options)
    ceres.solver_options.num_threads = 1
    if max_iterations is not None:
        ceres.solver_options.max_num_iterations = max_iterations
    if robust_scale is not None:
        ceres.loss_function_type, ceres.loss_function_scale = pycolmap.LossFunctionType.CAUCHY, robust_scale
    # pycolmap.bundle_adjustment would do the same, but turns COLMAP's log on (4.2.1).
    whole = pycolmap.BundleAdjustmentConfig()
    for number in model.reg_image_ids():
        whole.add_image(number)
    whole.fix_gauge(pycolmap.BundleAdjustmentGauge.TWO_CAMS_FROM_WORLD)
    pycolmap.create_default_bundle_adjuster(options, whole, model).solve()


#: Observations of an image below which it does not count for the correlation.
_FEWEST = 8
#: Side of the square whose mean is the brightness at a feature, pixels.
_BRIGHTNESS_WINDOW = 7


def depths_of(model: pycolmap.Reconstruction) -> dict[int, tuple[Int[np.ndarray, "K"], Float[np.ndarray, "K"]]]:
    """Feature indices and z-depths of the points that each registered image observes, by image ID."""
    numbers = np.array(sorted(model.points3D), np.int64)
    positions = np.array([model.points3D[number].xyz for number in numbers.tolist()]).reshape(-1, 3)
    depths = {}
    for number in sorted(model.reg_image_ids()):
        image = model.images[number]
        features = np.array(image.get_observation_point2D_idxs(), np.int64)
        point_ids = np.array([image.points2D[index].point3D_id for index in features.tolist()], np.int64)
        row = image.cam_from_world().matrix()[2]
        depths[number] = features, positions[np.searchsorted(numbers, point_ids)] @ row[:3] + row[3]
    return depths


def brightness_at(image: UInt8[np.ndarray, "H W 3"], pixels: Float[np.ndarray, "K 2"]) -> Float[np.ndarray, "K"]:
    """Mean of the red, green and blue values around pixels, 0 to 255."""
    import cv2

    mean = cv2.blur(image, (_BRIGHTNESS_WINDOW, _BRIGHTNESS_WINDOW)).mean(axis=2)
    column = np.clip(pixels[:, 0].astype(np.int64), 0, image.shape[1] - 1)
    row = np.clip(pixels[:, 1].astype(np.int64), 0, image.shape[0] - 1)
    return np.asarray(mean[row, column])


def brightness_correlation(
    model: pycolmap.Reconstruction, brightness: Sequence[Float[np.ndarray, "K"]]
) -> float | None:
    """Correlation of log brightness with log depth within the images; None where too few points are seen.

    With the lamp at the lens it is negative: what is nearer is brighter. The gain of each image drops out.
    ``brightness`` is that of each image's features, 0 to 255; image i has ID i + 1.
    """
    light, depth = [], []
    for number, (features, z) in depths_of(model).items():
        front = z > 0.0
        if front.sum() >= _FEWEST:
            logs = np.log(brightness[number - 1][features[front]] + 1.0), np.log(z[front])
            light.append(logs[0] - logs[0].mean())
            depth.append(logs[1] - logs[1].mean())
    if not light:
        return None
    lights, depths = np.concatenate(light), np.concatenate(depth)
    size = float(np.sqrt((lights**2).sum() * (depths**2).sum()))
    return float(lights @ depths) / size if size > 0.0 else None
