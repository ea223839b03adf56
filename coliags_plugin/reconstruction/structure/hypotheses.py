"""Choice among models of the same images with other cameras, or reversed in depth.

Images of distant, shallow surfaces nearly determine structure only up to a reversal of depth (the bas-relief or Necker
ambiguity: R. Szeliski and S. B. Kang, "Shape ambiguities in structure from motion", IEEE TPAMI 19(5), 1997). The lamp
at the lens resolves it: nearer points are brighter.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Float

from coliags_plugin.core.errors import InputError
from coliags_plugin.core.jobs import with_progress
from coliags_plugin.reconstruction.structure.adjustment import adjust, held_out_error
from coliags_plugin.reconstruction.structure.atlas import Again, held_part, part_of
from coliags_plugin.reconstruction.structure.mapping import brightness_correlation, bundle_adjust, depths_of
from coliags_plugin.reconstruction.structure.sfm_settings import (
    Start,
    candidate_cameras,
    distortion,
    field_of_view,
    is_refined,
    starting_cameras,
)
from coliags_plugin.reconstruction.structure.video import MatchedVideo

if TYPE_CHECKING:
    import pycolmap

log = logging.getLogger(__name__)

#: Models with at least these shares of the most images and observations explain the images as well as any.
_ENOUGH_IMAGES, _ENOUGH_OBSERVATIONS = 0.9, 0.9
#: Errors that differ by less than this factor do not tell models apart; the focal length is ambiguous if those of such
#: models differ by more than this factor.
_SAME_ERROR, _OTHER_FOCAL_LENGTH = 1.05, 1.15
#: A point nearer than this share of the median depth counts as this near when depth is reversed.
_NEAREST = 0.05
#: Reflects the z axis.
_MIRROR = np.diag([1.0, 1.0, -1.0])


@dataclass(frozen=True, eq=False)
class Hypothesis:
    """A bundle-adjusted model, and what it is compared with others by."""

    model: pycolmap.Reconstruction
    images: int  # number of registered ones
    observations: int  # of points
    error: float  # mean reprojection error, pixels
    camera: pycolmap.Camera  # the first
    fields_of_view: Sequence[float]  # nominal, of each camera, degrees
    correlation: float | None  # of log brightness with log depth; None: unknown
    is_reversed: bool = False  # made by reversing another one's depth
    joins: Mapping[int, Again] = field(default_factory=dict)  # places where models were joined, by the frame before

    @classmethod
    def of(
        cls, model: pycolmap.Reconstruction, brightness: Sequence[Float[np.ndarray, "K"]], is_reversed: bool = False
    ) -> Hypothesis:
        """The hypothesis of a bundle-adjusted model; ``brightness`` at the features of each image."""
        return cls(
            model,
            model.num_reg_images(),
            model.compute_num_observations(),
            model.compute_mean_reprojection_error(),
            next(iter(model.cameras.values())),
            [field_of_view(camera) for camera in model.cameras.values()],
            brightness_correlation(model, brightness),
            is_reversed,
        )

    @property
    def frames(self) -> list[int]:
        """Frames with a pose, ascending."""
        return [number - 1 for number in sorted(self.model.reg_image_ids())]

    @property
    def is_lit_from_the_camera(self) -> bool:
        """True if nearer points are brighter."""
        return self.correlation is not None and self.correlation < 0.0

    def is_plausible(self, plausible: tuple[float, float]) -> bool:
        """True if the nominal fields of view are in a range, degrees."""
        return all(plausible[0] <= view <= plausible[1] for view in self.fields_of_view)

    def described(self) -> str:
        """Description of camera, counts, error and light, for logs and errors."""
        light = "unknown" if self.correlation is None else f"{self.correlation:.2f}"
        return (
            f"{self.camera.model_name}, focal length {self.camera.mean_focal_length():.0f} px "
            f"({self.fields_of_view[0]:.0f} degrees), distortion {100.0 * distortion(self.camera):.0f} %"
            f"{', depth reversed' if self.is_reversed else ''}: "
            f"{self.images} images, {self.observations} observations, reprojection error {self.error:.3g} px, "
            f"correlation of brightness with depth {light}"
        )


def choose(hypotheses: Sequence[Hypothesis], plausible: tuple[float, float]) -> Hypothesis:
    """Choose the :func:`best` model of plausible nominal field of view, degrees; refuses models if none has one."""
    candidates = [hypothesis for hypothesis in hypotheses if hypothesis.is_plausible(plausible)]
    if not candidates:
        raise InputError(
            f"implausible focal lengths ({'; '.join(hypothesis.described() for hypothesis in hypotheses)})",
            f"a nominal field of view of {plausible[0]:g} to {plausible[1]:g} degrees",
            "Give the camera's calibration (`camera` and `params`, or a known `camera`), fix the focal length at a "
            "multiple of the larger side (`camera.refine=false` and `camera.focal_factors=[0.6]`), or state the "
            "range (`camera.field_of_view=[20, 150]`)",
        )
    return best(candidates)


def best(hypotheses: Sequence[Hypothesis]) -> Hypothesis:
    """Choose a model by completeness, then light from the camera, then reprojection error, then least distortion.

    Where errors hardly differ, the first (most likely) of each camera model is left, as focal length and distortion
    compensate each other; of these, that with the least distortion is taken, as a lens is near the law it was made for.
    """
    candidates = _explaining(hypotheses)
    candidates = [candidate for candidate in candidates if candidate.is_lit_from_the_camera] or candidates
    exact = min(candidate.error for candidate in candidates)
    firsts: dict[str, Hypothesis] = {}
    for candidate in candidates:
        if candidate.error <= _SAME_ERROR * exact:
            firsts.setdefault(candidate.camera.model_name, candidate)
    return min(firsts.values(), key=lambda candidate: distortion(candidate.camera))


def fitting_focal_lengths(
    hypotheses: Sequence[Hypothesis], chosen: Hypothesis, plausible: tuple[float, float]
) -> list[float]:
    """Focal lengths, pixels, of the chosen model and of plausible rivals with nearly the same reprojection error."""
    rivals = _explaining([hypothesis for hypothesis in hypotheses if hypothesis.is_plausible(plausible)])
    if chosen.is_lit_from_the_camera:
        rivals = [rival for rival in rivals if rival.is_lit_from_the_camera]
    fitting = [rival for rival in rivals if rival.error <= _SAME_ERROR * chosen.error]
    return [hypothesis.camera.mean_focal_length() for hypothesis in (chosen, *fitting)]


def _explaining(hypotheses: Sequence[Hypothesis]) -> list[Hypothesis]:
    """Models with nearly the most registered images and observations."""
    images = max((hypothesis.images for hypothesis in hypotheses), default=0)
    complete = [hypothesis for hypothesis in hypotheses if hypothesis.images >= _ENOUGH_IMAGES * images]
    observations = max((hypothesis.observations for hypothesis in complete), default=0)
    return [hypothesis for hypothesis in complete if hypothesis.observations >= _ENOUGH_OBSERVATIONS * observations]


def reversed_in_depth(model: pycolmap.Reconstruction, refine_camera: bool) -> pycolmap.Reconstruction:
    """A copy of the model with near and far exchanged, bundle-adjusted.

    In the frame of the middle registered camera, every point is moved along its ray to the median depth squared divided
    by its depth, and the rotations of the others to it are mirrored; the images change least this way.
    """
    import pycolmap

    reversal = pycolmap.Reconstruction(model)
    numbers = sorted(reversal.reg_image_ids())
    middle = reversal.images[numbers[len(numbers) // 2]]
    frame = middle.cam_from_world().matrix()
    depths = depths_of(reversal)[middle.image_id][1]
    median = float(np.median(depths[depths > 0.0])) if (depths > 0.0).any() else 1.0
    for point in reversal.points3D.values():
        local = frame[:, :3] @ point.xyz + frame[:, 3]
        local[2] = max(local[2], _NEAREST * median)
        point.xyz = frame[:, :3].T @ (local * (median / local[2]) ** 2 - frame[:, 3])
    center = np.array([0.0, 0.0, median])
    for number in numbers:
        pose = reversal.images[number].cam_from_world().matrix()
        rotation = pose[:, :3] @ frame[:, :3].T
        translation = pose[:, 3] - rotation @ frame[:, 3]
        mirrored = _MIRROR @ rotation @ _MIRROR
        # The centre of the scene keeps its place in every image.
        translation = rotation @ center + translation - mirrored @ center
        matrix = np.concatenate([mirrored @ frame[:, :3], (mirrored @ frame[:, 3] + translation)[:, None]], axis=1)
        reversal.frames[reversal.images[number].frame_id].rig_from_world = pycolmap.Rigid3d(matrix)
    bundle_adjust(reversal, refine_camera)
    return reversal


def both_signs(model: pycolmap.Reconstruction, video: MatchedVideo, refined: bool) -> list[Hypothesis]:
    """The model, bundle-adjusted in place if refined, and its reversal in depth unless it is lit from the camera."""
    if refined:
        bundle_adjust(model, refine_camera=True)
    signs = [Hypothesis.of(model, video.brightness)]
    if not signs[0].is_lit_from_the_camera:
        signs.append(Hypothesis.of(reversed_in_depth(model, refined), video.brightness, is_reversed=True))
    for hypothesis in signs:
        log.info("%s", hypothesis.described())
    return signs


#: Adds cameras to those that were tried; returns the best of all, and the focal lengths, pixels, that fit as well.
_Trial = Callable[[Sequence[Start]], tuple[Start, Sequence[float]]]


def find_camera(video: MatchedVideo, models: Sequence[pycolmap.Reconstruction] = ()) -> Start:
    """Estimate the camera model and focal length of a video, from its features or from ``models`` of its tracks.

    First lenses of one focal length are tried, then the other focal lengths with the best lens.
    """
    lenses, factors = candidate_cameras(video.settings.camera, bool(video.tracks))
    if len(lenses) == len(factors) == 1:
        return lenses[0]
    trial = _trial_on_tracks(models, video) if video.tracks else _trial_on_features(video)
    best, _ = trial(lenses)
    best, lengths = trial([replace(best, focal_factor=factor) for factor in factors[1:]])
    if max(lengths) > _OTHER_FOCAL_LENGTH * min(lengths):
        log.warning(
            "the images hardly determine the focal length (%.0f to %.0f px fit as well), and a wrong one distorts path "
            "and surface: give the camera's calibration (`camera`, `params`) if there is one",
            *(min(lengths), max(lengths)),
        )
    return best


def _trial_on_features(video: MatchedVideo) -> _Trial:
    """Make the trial of cameras on features: the middle of the video is mapped with each, and :func:`choose` decides.

    Where no model is plausible, the first camera is the best.
    """
    part, settings = video.search_part(), video.settings.camera
    hypotheses: list[Hypothesis] = []
    tried: list[Start] = []

    def trial(cameras: Sequence[Start]) -> tuple[Start, Sequence[float]]:
        for camera in with_progress(cameras, "try cameras", video.progress):
            tried.append(camera)
            for model in part.mapped(camera)[:1]:
                hypotheses.extend(both_signs(model, part, is_refined(settings)))
        try:
            chosen = choose(hypotheses, settings.field_of_view)
        except InputError:
            return tried[0], [1.0]
        side = max(part.sizes[0])
        lengths = fitting_focal_lengths(hypotheses, chosen, settings.field_of_view)
        return Start(chosen.camera.model_name, chosen.camera.mean_focal_length() / side), lengths

    return trial


#: Models on which cameras are tried, and their fewest images; cameras whose errors differ by less than this factor are
#: not told apart.
_TRIED_MODELS, _FEWEST_TRIED, _SAME_TEST = 3, 12, 1.02
#: Displacement of the points since the image before, as a share of the larger side, from which the camera has moved:
#: repeated images agree with any camera.
_MOVED = 0.0015


def _trial_on_tracks(models: Sequence[pycolmap.Reconstruction], video: MatchedVideo) -> _Trial:
    """Make the trial of cameras on tracks, by held-out ones in the middle of the largest models; ties: the first.

    The error of a camera is the geometric mean over these, pixels; infinite if unknown.
    """
    import pycolmap

    large = [model for model in models[:_TRIED_MODELS] if model.num_reg_images() >= _FEWEST_TRIED] or models[:1]
    parts = [_middle_of(model, video) for model in large]
    errors: dict[Start, float] = {}

    def trial(cameras: Sequence[Start]) -> tuple[Start, Sequence[float]]:
        for camera in with_progress(cameras, "try cameras", video.progress):
            measured = []
            for part in parts:
                tried = pycolmap.Reconstruction(part)
                with_camera(tried, video, camera)
                adjust(tried, video.track_ids)
                error = held_out_error(tried, video.tracks, 0.0)
                measured += [] if error is None else [error]
            errors[camera] = float(np.exp(np.mean(np.log(measured)))) if measured else np.inf
            shape = "" if camera.radial is None else f", distortion {camera.radial:g}"
            log.info(
                "%s, focal length %.2f of the larger side%s: error of held-out tracks %.3f px",
                *(camera.model, camera.focal_factor, shape, errors[camera]),
            )
        fitting = [camera for camera, error in errors.items() if error <= _SAME_TEST * min(errors.values())]
        return fitting[0], [camera.focal_factor * max(video.sizes[0]) for camera in fitting]

    return trial


def _middle_of(model: pycolmap.Reconstruction, video: MatchedVideo) -> pycolmap.Reconstruction:
    """Part of a model: a few images around its middle, of those before which the camera has moved."""
    count = video.settings.search_images
    every = [number - 1 for number in sorted(model.reg_image_ids())]
    frames = [frame for frame in every if video.tracks[frame].shift >= _MOVED]
    frames = frames if len(frames) >= _FEWEST_TRIED else every
    first = max(0, (len(frames) - count) // 2)
    return part_of(model, frames[first : first + count])


def with_camera(model: pycolmap.Reconstruction, video: MatchedVideo, start: Start) -> None:
    """Set the parameters of the model's camera, in place; the images have one size."""
    (camera,) = starting_cameras(video.settings.camera, video.images, video.sizes, start)
    for mine in model.cameras.values():
        mine.params = camera.params


def adjusted(model: pycolmap.Reconstruction, video: MatchedVideo) -> Hypothesis:
    """Adjust a model by all its tracks, reverse its depth if the lamp tells so, and drop images of implausible pose."""
    adjust(model, video.track_ids)
    chosen = best(both_signs(model, video, refined=False))
    if chosen.is_reversed:
        adjust(chosen.model, video.track_ids)
    return Hypothesis.of(held_part(chosen.model), video.brightness, chosen.is_reversed)
