"""Options of structure from motion, and cameras with which it starts: guessed, given, or of a known endoscope."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Literal

import numpy as np
from jaxtyping import Bool, UInt8
from pydantic import Field, model_validator
from typing_extensions import Self

from coliags_plugin.core.errors import InputError
from coliags_plugin.core.images import HIGHLIGHT_LEVEL, HIGHLIGHT_RATIO
from coliags_plugin.core.settings import Settings
from coliags_plugin.geometry.lenses.models import LENSES, FisheyeLens, Lens

if TYPE_CHECKING:
    import pycolmap


class FeatureSettings(Settings):
    """Options of SIFT extraction. COLMAP's defaults find about a hundred points on a colon's wall."""

    peak_threshold: float = Field(
        default=0.001, gt=0.0, description="SIFT peak (contrast) threshold. COLMAP's default is 0.0067."
    )
    max_features: int = Field(
        default=4000, ge=1, description="Largest number of features per image; those of the largest scale are kept."
    )
    upright: bool = Field(
        default=True,
        description="Upright SIFT, without orientation: more features match, as long as the camera rolls by less than "
        "about 20 degrees between matched images.",
    )
    highlight_level: int = Field(
        default=HIGHLIGHT_LEVEL,
        ge=1,
        le=256,
        description="Brightness (of 255) from which a pixel is a highlight; 256: none is.",
    )
    highlight_ratio: float = Field(
        default=HIGHLIGHT_RATIO,
        gt=1.0,
        description="A pixel this many times as bright as its surroundings, and brighter by at least 20 of 255, is "
        "also a highlight; highlights move with the light source.",
    )
    margin: int = Field(default=3, ge=0, description="Dilation of highlights and masks, pixels.")


class CameraSettings(Settings):
    """Camera model and initial intrinsics, shared by all images."""

    model: str | None = Field(
        default=None,
        description="COLMAP camera model, for instance OPENCV_FISHEYE; or a calibrated camera, scaled to the images: "
        "c3vd, c3vd-undistorted, or that of a calibration file, NAME.xml. None: SIMPLE_RADIAL_FISHEYE and "
        "SIMPLE_RADIAL are tried.",
    )
    params: tuple[float, ...] | None = Field(
        default=None,
        description="The model's parameters, in COLMAP's order; pixels, pixel centres at integers + 0.5. None: "
        "estimated, or those of the calibrated camera.",
    )
    refine: bool | None = Field(
        default=None, description="Whether focal length and distortion are refined. None: if they are not known."
    )
    focal_factors: tuple[float, ...] = Field(
        default=(0.75, 0.5),
        min_length=1,
        description="Initial focal lengths to try, relative to the image's larger side, the most likely first, "
        "which alone is tried of SIMPLE_RADIAL where the camera model is unknown too. Endoscopes have 0.4 to 1.2.",
    )
    field_of_view: tuple[float, float] = Field(
        default=(40.0, 150.0),
        description="Plausible nominal fields of view, degrees: of the image's larger side, 2 atan(side / 2f), or "
        "side / f of a fisheye. A model with another one is refused.",
    )

    @model_validator(mode="after")
    def _ranges(self) -> Self:
        if self.params is not None and self.model is None:
            raise ValueError("parameters (`params`) without their camera model (`camera`)")
        if not min(self.focal_factors) > 0.0:
            raise ValueError(f"focal_factors = {self.focal_factors}: they must be positive")
        if not 0.0 < self.field_of_view[0] < self.field_of_view[1] < 180.0:
            raise ValueError(f"field_of_view = {self.field_of_view}: two ascending angles between 0 and 180 degrees")
        return self


class TrackSettings(Settings):
    """Options of point tracks."""

    side: int = Field(
        default=384, ge=64, description="Larger side of the images that are tracked, pixels; larger ones are reduced."
    )
    corners: int = Field(default=1400, ge=100, description="Number of points followed, topped up in every frame.")
    longest_window: int = Field(
        default=400,
        ge=8,
        description="Largest number of frames mapped together; longer videos are cut where few points are followed.",
    )


class SfmSettings(Settings):
    """Options of matching and mapping."""

    camera: CameraSettings = CameraSettings()
    """Camera model and initial intrinsics, shared by all images."""
    features: FeatureSettings = FeatureSettings(max_features=6000, peak_threshold=0.002)
    """Feature extraction."""
    matching: Literal["auto", "tracks", "features"] = Field(
        default="auto",
        description="What is matched: points tracked from frame to frame through a video, or SIFT features. auto: "
        "features where neighbouring images have plenty of them in common, and where tracks do not hold either.",
    )
    tracks: TrackSettings = TrackSettings()
    """Tracking of points."""
    features_at_most: int = Field(
        default=300,
        ge=2,
        description="Largest number of images of which features are matched: of more, the sharpest of every n.",
    )
    exhaustive_up_to: int = Field(default=25, ge=0, description="Up to this many images are matched exhaustively.")
    min_alike: int = Field(
        default=12,
        ge=1,
        description="Images further apart than two are matched if at least this many of their largest features match.",
    )
    max_ratio: float = Field(default=0.8, gt=0.0, le=1.0, description="Largest ratio in Lowe's ratio test.")
    min_model_size: int = Field(default=3, ge=2, description="Least number of registered images of a model.")
    search_images: int = Field(
        default=24,
        ge=3,
        description="An unknown camera is chosen on this many images from the middle of the video; with tracks, from "
        "the middle of each of the three largest models.",
    )
    seed: int = Field(default=0, ge=0, description="Seed of COLMAP's random samples.")


#: Calibrated cameras by name: the lens of :data:`LENSES` whose pinhole (undistorted images) or which itself took the
#: images.
CALIBRATED = {"c3vd": "fisheye", "c3vd-undistorted": "legacy-pinhole"}
#: Camera models that are tried where none is given: endoscopes have fisheye lenses, but images may be undistorted.
_FISHEYE, _UNDISTORTED = "SIMPLE_RADIAL_FISHEYE", "SIMPLE_RADIAL"
#: Largest deviation of an image's aspect ratio from the calibrated one's.
_ASPECT_TOLERANCE = 0.02


@dataclass(frozen=True)
class Start:
    """Camera that mapping starts with."""

    model: str  # of COLMAP, or of CALIBRATED
    focal_factor: float  # focal length relative to the image's larger side, where no parameters are known
    radial: float | None = None  # the model's last parameter, its only one of distortion; None: undistorted


#: Share of the image's width and height from which the lens's picture fills it; brightness (of 255) of surroundings.
_FILLED, _DARK = 0.95, 16


@dataclass(frozen=True)
class Picture:
    """The part of the images that the lens's picture takes up within black surroundings; its centre is the lens's."""

    corner: tuple[int, int]  # column and row of its first pixel
    size: tuple[int, int]  # width and height
    frame: tuple[int, int]  # width and height of the images

    @classmethod
    def in_mask(cls, mask: Bool[np.ndarray, "H W"], image: UInt8[np.ndarray, "H W 3"]) -> Picture | None:
        """The rectangle around what is not masked, or masked but mostly bright; None where it is nearly all."""
        lit = image.max(axis=2) > _DARK
        spans = []
        for axis in (0, 1):
            used = np.flatnonzero(mask.any(axis=axis) | (lit.mean(axis=axis) > 0.5))
            spans.append((int(used[0]), int(used[-1]) + 1) if len(used) else (0, mask.shape[1 - axis]))
        size = (spans[0][1] - spans[0][0], spans[1][1] - spans[1][0])
        frame = (mask.shape[1], mask.shape[0])
        if all(part >= _FILLED * whole for part, whole in zip(size, frame, strict=True)):
            return None
        return cls((spans[0][0], spans[1][0]), size, frame)

    def to_frame(self, model: pycolmap.Reconstruction) -> None:
        """Change cameras and keypoints of a model of the picture to those of whole images, in place."""
        for camera in model.cameras.values():
            camera.width, camera.height = self.frame
            camera.principal_point_x += self.corner[0]
            camera.principal_point_y += self.corner[1]
        for image in model.images.values():
            for point in image.points2D:
                point.xy = point.xy + np.array(self.corner, float)


#: Distortion of the fisheye lenses tried on tracks, the most likely first: nearly a pinhole's image, whose radius is
#: tan(x) = x + x^3 / 3 + ..., equal angles at equal distances, and between; and focal lengths, relative to the side.
_RADIALS, _TRACKED_FACTORS = (0.333, 0.0, 0.167), (0.57, 0.4, 0.48, 0.68, 0.82, 1.0)


def candidate_cameras(settings: CameraSettings, tracked: bool) -> tuple[list[Start], list[float]]:
    """Lenses to try, all of one focal length, and the focal lengths relative to the larger side, this one first.

    The most likely come first; a known camera is the only one. Features tell the distortion, so that a fisheye and a
    pinhole are tried on them; on tracks it is fixed.
    """
    factors = list(_TRACKED_FACTORS if tracked and settings.refine is not False else settings.focal_factors)
    if has_known_camera(settings):
        factors = factors[:1]
    if settings.model is not None:
        return [Start(settings.model, factors[0])], factors
    if not tracked:
        return [Start(model, factors[0]) for model in (_FISHEYE, _UNDISTORTED)], factors
    radials = (None,) if settings.refine is False else _RADIALS
    return [Start(_FISHEYE, factors[0], radial) for radial in radials], factors


def has_known_camera(settings: CameraSettings) -> bool:
    """True if parameters are given or calibrated."""
    return settings.params is not None or settings.model in CALIBRATED


def is_refined(settings: CameraSettings) -> bool:
    """True if focal length and distortion are refined."""
    return not has_known_camera(settings) if settings.refine is None else settings.refine


def camera_of_lens(whole: Lens, origin: str, width: int, height: int) -> tuple[str, tuple[float, ...]]:
    """COLMAP's model and parameters of a lens, scaled to images of its whole frame; ``origin`` names it in errors."""
    if abs((width / height) / (whole.width / whole.height) - 1.0) > _ASPECT_TOLERANCE:
        raise InputError(
            f"{origin}, and images of {width} x {height}",
            f"the whole frame, {whole.width} x {whole.height} or scaled from it",
            "For cropped images, subtract the crop's corner from the principal point and pass `camera=OPENCV_FISHEYE` "
            "and `params`",
        )
    lens = whole.resized(width, height)
    k = lens.pinhole
    pinhole = (k.fx, k.fy, k.cx, k.cy)
    if isinstance(lens, FisheyeLens):
        return "OPENCV_FISHEYE", (*pinhole, lens.k1, lens.k2, lens.k3, lens.k4)
    return "PINHOLE", pinhole


def starting_cameras(
    settings: CameraSettings, images: Sequence[Path], sizes: Sequence[tuple[int, int]], start: Start
) -> list[pycolmap.Camera]:
    """One camera per image size, in order of first appearance; ``images`` are the files, for errors."""
    import pycolmap

    colmap_models = {name for name in pycolmap.CameraModelId.__members__ if name != "INVALID"}
    if start.model not in colmap_models | set(CALIBRATED):
        raise InputError(
            f"camera model {start.model}", f"one of {', '.join(CALIBRATED)}, {', '.join(sorted(colmap_models))}"
        )
    if start.model in CALIBRATED and settings.params is not None:
        raise InputError(f"`params`, and `camera={start.model}`", "`params` with a model of COLMAP", "Drop `params`")
    cameras = []
    for width, height in dict.fromkeys(sizes):
        model, params = start.model, settings.params
        if model in CALIBRATED:
            model, params = camera_of_lens(LENSES[CALIBRATED[model]], f"`camera={model}`", width, height)
        focal_length = start.focal_factor * max(width, height)
        camera = pycolmap.Camera.create_from_model_name(0, model, focal_length, width, height)
        if start.radial is not None:
            camera.params = [*camera.params[:-1], start.radial]
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


def field_of_view(camera: pycolmap.Camera, side: float | None = None) -> float:
    """Nominal (undistorted) field of view of the larger side, degrees: 2 atan(side / 2f), or side / f of a fisheye.

    ``side``, pixels, is that of the lens's picture where it does not fill the images.
    """
    return float(np.degrees(2.0 * _border(camera, side)[1]))


def distortion(camera: pycolmap.Camera) -> float:
    """Displacement by distortion at the nominal border of the larger side, relative to the distance from the centre."""
    radius, angle = _border(camera)
    axis = 0 if camera.width >= camera.height else 1
    ray = np.array([0.0, 0.0, np.cos(angle)])
    ray[axis] = np.sin(angle)
    center = (camera.principal_point_x, camera.principal_point_y)[axis]
    return abs(float(camera.img_from_cam(ray[None])[0][axis] - center) / radius - 1.0)


def _border(camera: pycolmap.Camera, side: float | None = None) -> tuple[float, float]:
    """Half of the larger side, pixels, and its nominal angle from the optical axis, radians."""
    radius = 0.5 * (side or max(camera.width, camera.height))
    tangent = radius / camera.mean_focal_length()
    return radius, float(tangent if "FISHEYE" in camera.model_name else np.arctan(tangent))
