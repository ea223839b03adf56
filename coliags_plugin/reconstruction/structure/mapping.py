"""COLMAP's geometric verification, incremental mapping and bundle adjustment, on one thread for determinism."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from coliags_plugin.core.progress import Progress
from coliags_plugin.reconstruction.structure.sfm_settings import SfmSettings

if TYPE_CHECKING:
    import pycolmap


def map_images(
    database: Path, scratch: Path, settings: SfmSettings, count: int, progress: Progress | None
) -> list[pycolmap.Reconstruction]:
    """Models of verified matches by incremental mapping with fixed intrinsics, the largest first.

    Intrinsics that are to be refined stay fixed until all images are registered (:func:`bundle_adjust`): with few
    images, motion along the optical axis makes them diverge.

    Args:
        database: Features and matches.
        scratch: A new folder for COLMAP's files.
        settings: Of mapping.
        count: Number of images, for the progress.
        progress: Progress callback.
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

    found = pycolmap.incremental_mapping(
        str(database),
        str(scratch),
        str(scratch),
        options,
        initial_image_pair_callback=start,
        next_image_callback=next_image,
    )
    return sorted(found.values(), key=lambda model: -model.num_reg_images())


def bundle_adjust(model: pycolmap.Reconstruction, refine_camera: bool) -> None:
    """Global bundle adjustment of poses and points, followed by point filtering; done twice.

    Args:
        model: Adjusted in place.
        refine_camera: Whether focal length and distortion are adjusted too.
    """
    import pycolmap

    options = pycolmap.BundleAdjustmentOptions()
    options.print_summary = False
    options.refine_focal_length = options.refine_extra_params = refine_camera
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
