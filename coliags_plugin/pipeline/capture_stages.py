"""Stages from a video to a posed scene with depth: frames, poses, check, depth."""

from __future__ import annotations

from dataclasses import replace

from coliags_plugin.core.errors import InputError
from coliags_plugin.core.files import write_json
from coliags_plugin.datamanagers.units import Unit
from coliags_plugin.pipeline.context import StageContext
from coliags_plugin.pipeline.frame_sources import chosen_frames
from coliags_plugin.pipeline.frames import IMAGES, read_lens_mask, write_frames
from coliags_plugin.pipeline.settings import FEWEST
from coliags_plugin.pipeline.stages import StageOutcome

#: Share of the frames below which it is said that the poses are of a part of the video only.
_MOST = 0.7


def make_frames(context: StageContext) -> StageOutcome:
    """Write the frames of use, and their mask."""
    source = chosen_frames(context.source, context.settings.frames)
    summary = write_frames(source, context.frames, context.settings.frames, context.mask, context.progress)
    return StageOutcome(
        summary, {"frames/images": "frames of use, PNG", "frames/frames.json": "which frames were dropped, and why"}
    )


def make_poses(context: StageContext) -> StageOutcome:
    """Estimate poses and points by structure from motion, and write them as a scene."""
    from coliags_plugin.engine.data_formats import UNKNOWN_MEDIAN_DEPTH
    from coliags_plugin.reconstruction.structure.colmap_scene import RIBBON_FILE, write_sfm_scene
    from coliags_plugin.reconstruction.structure.image_files import list_images
    from coliags_plugin.reconstruction.structure.sfm import millimetres, reconstruct, scaled

    settings = context.settings
    mask = read_lens_mask(context.frames)
    atlas = reconstruct(list_images(context.frames / IMAGES), settings.sfm, mask, context.progress)
    largest, count = atlas.largest, len(atlas.images)
    if len(largest.registered) < FEWEST:
        raise InputError(
            f"{len(largest.registered)} of {count} frames have poses",
            f"at least {FEWEST}",
            "Choose a part of the video in which the camera moves along tissue that it sees well, keep more frames "
            "(--every), or give the camera (--camera)",
        )
    warnings = []
    if (posed := count - len(atlas.lost)) < _MOST * count:
        warnings.append(f"{posed} of {count} frames have a pose: poses/{RIBBON_FILE} shows why the others have none")
    used = [model for model in atlas.models if model is largest or len(model.registered) >= settings.least_submap]
    factors = [millimetres(model, settings.diameter) for model in used]
    models = [
        scaled(model, factor or UNKNOWN_MEDIAN_DEPTH / model.median_depth)
        for model, factor in zip(used, factors, strict=True)
    ]
    atlas = replace(atlas, models=(*models, *atlas.models[len(used) :]))
    units: list[Unit] = ["unknown" if factor is None else "mm" for factor in factors]
    write_sfm_scene(context.posed, atlas, mask, overwrite=True, units=units, link=True)
    depth = atlas.largest.median_depth
    unit = (
        f"unit of length unknown (--diameter gives one): the median depth is made {UNKNOWN_MEDIAN_DEPTH:g}"
        if units[0] == "unknown"
        else f"unit mm, by a diameter of {settings.diameter:g} mm; median depth {depth:.3g} mm"
    )
    made = {"poses": "scene in COLMAP's layout: images, poses, points", f"poses/{RIBBON_FILE}": "frames with a pose"}
    return StageOutcome(f"{atlas.summary()}; {unit}", made, warnings)


def check_data(context: StageContext) -> StageOutcome:
    """Check that images, poses and calibration agree. What is suspect is said, and does not stop."""
    from coliags_plugin.checks.data.check import check_scene
    from coliags_plugin.checks.data.page import check_page, verdict
    from coliags_plugin.reporting.html_page import write_html

    scene = context.open_posed()
    check = check_scene(
        scene, context.progress, (lambda: context.open_posed(stored_size=True)) if scene.is_resized else None
    )
    write_html(check_page(check), context.folder / "check.html")
    write_json(context.folder / "check.json", check.as_json())
    made = {"check.html": "consistency of images, poses and calibration", "check.json": "the same as JSON"}
    warnings = [f"suspect: {finding.what} ({finding.evidence}). {finding.do}" for finding in check.findings]
    return StageOutcome(verdict(check), made, warnings, {"frames": len(scene.video)})


def estimate_depth(context: StageContext) -> StageOutcome:
    """Estimate dense depth with its confidence; goes on where a kill has left it."""
    from coliags_plugin.reconstruction.depth.scene import DepthRequest, estimate_scene

    request = DepthRequest(context.settings.depth)
    estimated = estimate_scene(
        context.open_posed(), context.estimated, request, overwrite=True, progress=context.progress
    )
    made = {"depth": "scene in nerfstudio's layout: images, poses, depth, confidence, points"}
    return StageOutcome(estimated.summary, made, estimated.warnings)
