"""Stages from a video to a posed scene with depth: frames, poses, check, depth."""

from __future__ import annotations

import logging

from coliags_plugin.core.errors import InputError
from coliags_plugin.core.files import write_json
from coliags_plugin.pipeline.context import StageContext
from coliags_plugin.pipeline.frame_sources import frame_source
from coliags_plugin.pipeline.frames import FEWEST, IMAGES, read_lens_mask, write_frames
from coliags_plugin.pipeline.stages import StageOutcome

log = logging.getLogger(__name__)

#: Median depth of a model whose scale is unknown, units: with about the depth that colons have in mm, constants in mm
#: (docs/methods.md 4.4) have about the effect that they have on a colon.
UNKNOWN_MEDIAN_DEPTH = 30.0
#: Share of the frames below which it is said that the poses are of a part of the video only.
_MOST = 0.7


def make_frames(context: StageContext) -> StageOutcome:
    """Write the frames of use, and their mask."""
    source = frame_source(context.source)
    summary = write_frames(source, context.frames, context.settings.frames, context.mask, context.progress)
    return StageOutcome(
        summary, {"frames/images": "frames of use, PNG", "frames/frames.json": "which frames were dropped, and why"}
    )


def make_poses(context: StageContext) -> StageOutcome:
    """Estimate poses and points by structure from motion, and write them as a scene."""
    from coliags_plugin.reconstruction.structure.colmap_scene import RIBBON_FILE, write_sfm_scene
    from coliags_plugin.reconstruction.structure.image_files import list_images
    from coliags_plugin.reconstruction.structure.model_scale import atlas_scaled, millimetres
    from coliags_plugin.reconstruction.structure.sfm import reconstruct

    mask = read_lens_mask(context.frames)
    atlas = reconstruct(list_images(context.frames / IMAGES), context.settings.sfm, mask, context.progress)
    model = atlas.largest
    posed, count = len(model.registered), len(model.images)
    if posed < FEWEST:
        raise InputError(
            f"{posed} of {count} frames have poses",
            f"at least {FEWEST}",
            "Choose a part of the video in which the camera moves along tissue that it sees well, keep more frames "
            "(--every), or give the camera (--camera)",
        )
    if posed < _MOST * count:
        log.warning("the surface is of the largest model, %d of %d frames: see poses/%s", posed, count, RIBBON_FILE)
    factor = millimetres(model, context.settings.diameter)
    atlas = atlas_scaled(atlas, UNKNOWN_MEDIAN_DEPTH / model.median_depth if factor is None else factor)
    write_sfm_scene(context.posed, atlas, mask, overwrite=True, unit="unknown" if factor is None else "mm")
    depth = atlas.largest.median_depth
    unit = (
        f"unit of length unknown (--diameter gives one): the median depth is made {UNKNOWN_MEDIAN_DEPTH:g}"
        if factor is None
        else f"unit mm, by a diameter of {context.settings.diameter:g} mm; median depth {depth:.3g} mm"
    )
    made = {"poses": "scene in COLMAP's layout: images, poses, points", f"poses/{RIBBON_FILE}": "frames with a pose"}
    return StageOutcome(f"{atlas.summary()}; {unit}", made)


def check_data(context: StageContext) -> StageOutcome:
    """Check that images, poses and calibration agree. What is suspect is said, and does not stop."""
    from coliags_plugin.checks.data.check import check_scene
    from coliags_plugin.checks.data.page import check_page, verdict
    from coliags_plugin.reporting.html_page import write_html

    scene = context.open_posed()
    check = check_scene(
        scene, context.progress, (lambda: context.open_posed(stored_size=True)) if scene.is_resized else None
    )
    if context.anonymous:
        check = check.anonymous()
    write_html(check_page(check), context.out / "check.html")
    write_json(context.out / "check.json", check.as_json())
    for finding in check.findings:
        log.warning("suspect: %s (%s). %s", finding.what, finding.evidence, finding.do)
    return StageOutcome(
        verdict(check), {"check.html": "consistency of images, poses and calibration", "check.json": "the same as JSON"}
    )


def estimate_depth(context: StageContext) -> StageOutcome:
    """Estimate dense depth with its confidence; goes on where a kill has left it."""
    from coliags_plugin.reconstruction.depth.scene import DepthRequest, estimate_scene

    request = DepthRequest(context.settings.depth)
    summary = estimate_scene(
        context.open_posed(), context.estimated, request, overwrite=True, progress=context.progress
    )
    return StageOutcome(summary, {"depth": "scene in nerfstudio's layout: images, poses, depth, confidence, points"})
