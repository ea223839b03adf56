"""Cameras with which structure from motion starts: guessed, given, or of a known endoscope."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from coliags_plugin.core.errors import InputError
from coliags_plugin.lenses.models import LENSES, FisheyeLens
from coliags_plugin.reconstruction.structure.sfm_settings import CameraSettings

if TYPE_CHECKING:
    import pycolmap

#: Calibrated cameras by name: the lens of :data:`LENSES` whose pinhole (undistorted images) or which itself took the
#: images.
CALIBRATED = {"c3vd": "fisheye", "c3vd-undistorted": "legacy-pinhole"}
#: Largest deviation of an image's aspect ratio from the calibrated one's.
_ASPECT_TOLERANCE = 0.02


def has_known_camera(settings: CameraSettings) -> bool:
    """Whether parameters are given or calibrated."""
    return settings.params is not None or settings.model in CALIBRATED


def is_refined(settings: CameraSettings) -> bool:
    """Whether focal length and distortion are refined."""
    return not has_known_camera(settings) if settings.refine is None else settings.refine


def calibrated_camera(name: str, width: int, height: int) -> tuple[str, tuple[float, ...]]:
    """COLMAP's model and parameters of a known camera, scaled to an image size.

    Args:
        name: Of :data:`CALIBRATED`.
        width: Of the images, which show the whole frame, pixels.
        height: Likewise.

    Raises:
        InputError: The images have another aspect ratio than the whole frame.
    """
    whole = LENSES[CALIBRATED[name]]
    if abs((width / height) / (whole.width / whole.height) - 1.0) > _ASPECT_TOLERANCE:
        raise InputError(
            f"--camera {name}, and images of {width} x {height}",
            f"the whole frame, {whole.width} x {whole.height} or scaled from it",
            "For cropped images, subtract the crop's corner from the principal point and pass --camera OPENCV_FISHEYE "
            "and --params",
        )
    lens = whole.resized(width, height)
    k = lens.pinhole
    pinhole = (k.fx, k.fy, k.cx, k.cy)
    if isinstance(lens, FisheyeLens):
        return "OPENCV_FISHEYE", (*pinhole, lens.k1, lens.k2, lens.k3, lens.k4)
    return "PINHOLE", pinhole


def starting_cameras(
    settings: CameraSettings, images: Sequence[Path], sizes: Sequence[tuple[int, int]], focal_factor: float
) -> list[pycolmap.Camera]:
    """One camera per image size, in order of first appearance.

    Args:
        settings: Model and parameters.
        images: Files, for errors.
        sizes: Width and height of each.
        focal_factor: Focal length relative to the larger side, where no parameters are known.

    Raises:
        InputError: The model is unknown, the parameters do not fit it, or sizes differ where parameters are given.
    """
    import pycolmap

    known = {name for name in pycolmap.CameraModelId.__members__ if name != "INVALID"}
    if settings.model not in known | set(CALIBRATED):
        raise InputError(
            f"camera model {settings.model}", f"one of {', '.join(CALIBRATED)}, {', '.join(sorted(known))}"
        )
    if settings.model in CALIBRATED and settings.params is not None:
        raise InputError(f"--params, and --camera {settings.model}", "--params with a model of COLMAP", "Drop --params")
    cameras = []
    for width, height in dict.fromkeys(sizes):
        model, params = settings.model, settings.params
        if model in CALIBRATED:
            model, params = calibrated_camera(model, width, height)
        camera = pycolmap.Camera.create_from_model_name(0, model, focal_factor * max(width, height), width, height)
        if params is not None:
            if len(params) != len(camera.params):
                raise InputError(f"{len(params)} parameters for {model}", f"{len(camera.params)}: {camera.params_info}")
            camera.params = list(params)
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


def field_of_view(camera: pycolmap.Camera) -> float:
    """Nominal field of view of the larger side, 2 atan(side / 2f), degrees."""
    return float(np.degrees(2.0 * np.arctan(0.5 * max(camera.width, camera.height) / camera.mean_focal_length())))
