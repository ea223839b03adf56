"""Choice of an unknown camera's model and focal length on a part of a video."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from typing import TYPE_CHECKING

from coliags_plugin.core.errors import InputError
from coliags_plugin.core.progress import Progress
from coliags_plugin.reconstruction.structure.hypotheses import (
    Hypothesis,
    best,
    choose,
    is_ambiguous,
    reversed_in_depth,
)
from coliags_plugin.reconstruction.structure.mapping import bundle_adjust
from coliags_plugin.reconstruction.structure.sfm_cameras import Start, is_refined, starts
from coliags_plugin.reconstruction.structure.sfm_settings import SfmSettings
from coliags_plugin.reconstruction.structure.video import Video

if TYPE_CHECKING:
    import pycolmap

log = logging.getLogger(__name__)


def find_start(video: Video, settings: SfmSettings, progress: Progress | None = None) -> Start:
    """Camera model and focal length to map a video from, chosen on its middle if there are several candidates.

    The part is mapped from each of :func:`~coliags_plugin.reconstruction.structure.sfm_cameras.starts`; the models, and
    their reversals in depth, are bundle-adjusted and compared
    (:func:`~coliags_plugin.reconstruction.structure.hypotheses.choose`). Where no model is plausible, the first start.

    Args:
        video: Features and matches.
        settings: Of the camera and of mapping.
        progress: Progress callback.
    """
    tried = starts(settings.camera)
    if len(tried) == 1:
        return tried[0]
    part, refined = video.middle(settings.search_images), is_refined(settings.camera)
    hypotheses = []
    for done, start in enumerate(tried, start=1):
        for model in part.mapped(settings, start, None)[:1]:
            hypotheses += both_signs(model, part, refined)
        if progress is not None:
            progress("try cameras", done, len(tried))
    plausible = settings.camera.field_of_view
    try:
        chosen = choose(hypotheses, plausible)
    except InputError:
        return tried[0]
    _compare(chosen, hypotheses, plausible)
    if is_ambiguous(hypotheses, chosen, plausible):
        log.warning(
            "the images hardly determine the focal length, and a wrong one distorts path and surface: give the "
            "camera's calibration (--camera, --params) if there is one"
        )
    camera = next(iter(chosen.model.cameras.values()))
    return Start(chosen.camera_model, float(camera.mean_focal_length() / max(camera.width, camera.height)))


def both_signs(model: pycolmap.Reconstruction, video: Video, refined: bool) -> list[Hypothesis]:
    """The bundle-adjusted model, and its reversal in depth unless it is lit from the camera.

    Args:
        model: Adjusted in place.
        video: Its images.
        refined: Whether focal length and distortion are adjusted too.
    """
    if refined:
        bundle_adjust(model, refine_camera=True)
    found = Hypothesis.of(model, video.brightness)
    if found.is_lit_from_the_camera:
        return [found]
    return [found, Hypothesis.of(reversed_in_depth(model, refined), video.brightness, is_reversed=True)]


def _compare(chosen: Hypothesis, hypotheses: Sequence[Hypothesis], plausible: tuple[float, float]) -> None:
    """Log how far each other camera model's best is from the chosen one."""
    for name in dict.fromkeys(one.camera_model for one in hypotheses):
        rivals = [one for one in hypotheses if one.camera_model == name and one.is_plausible(plausible)]
        if name == chosen.camera_model or not rivals:
            continue
        rival = best(rivals)
        log.info(
            "%s is taken; %s at best has %+.1f %% reprojection error, %+.1f %% observations, %+.1f %% focal length",
            chosen.camera_model,
            name,
            *(
                100.0 * (other / own - 1.0)
                for other, own in (
                    (rival.error, chosen.error),
                    (rival.observations, chosen.observations),
                    (rival.focal_length, chosen.focal_length),
                )
            ),
        )
