"""From a video, a folder of images or a posed scene to mesh and report, in stages that a repeated call goes on with."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import torch

from coliags_plugin.config.method_config import load_method
from coliags_plugin.core.errors import InputError
from coliags_plugin.core.files import refuse_overlap
from coliags_plugin.core.locks import locked
from coliags_plugin.core.progress import Progress
from coliags_plugin.datamanagers.recognition import find_format, recognised
from coliags_plugin.pipeline import capture_stages, training_stages
from coliags_plugin.pipeline.context import StageContext
from coliags_plugin.pipeline.frame_sources import frame_source
from coliags_plugin.pipeline.page import write_index
from coliags_plugin.pipeline.settings import FrameSettings, ReconstructionSettings
from coliags_plugin.pipeline.stages import LOCK_FILE, Record, Stage, StageOutcome, run_stages
from coliags_plugin.reconstruction.structure.sfm_settings import SfmSettings


def reconstruct(
    source: Path,
    out: Path,
    settings: ReconstructionSettings,
    device: torch.device,
    mask: Path | None = None,
    overwrite: bool = False,
    progress: Progress | None = None,
    anonymous: bool = False,
) -> Record:
    """Reconstruct a video, or go on with what was begun; arguments as in :func:`coliags_plugin.reconstruct`.

    Raises:
        InputError: The source cannot be read; a stage cannot be done; ``out`` is something else, or was made with
            other settings; or another process works on it.
        InterruptedRunError: Ctrl-C in training, after the state was saved.
    """
    refuse_overlap(out, source)
    if mask is not None and not mask.is_file():
        raise InputError(f"no file {mask}", "an image, black where pixels are ignored", "Check --mask")
    data_format = find_format(source) if source.is_dir() and recognised(source) else None
    if data_format is None:
        frame_source(source)
    else:
        _refuse_unused(source, settings, mask)
    Record.of(out)  # refuses another folder before anything is written
    context = StageContext(out, source, settings, mask, data_format, device, progress, anonymous)
    stages = stages_of(context)
    with locked(out / LOCK_FILE, out):
        record = Record.of(out)
        record.is_anonymous = anonymous
        record.write()  # so that the folder is known for one from now on, whatever happens in the first stage
        failure = run_stages(stages, record, overwrite, lambda: stages_of(context))
        write_index(record, context.posed, f"Reconstruction of {source.resolve().name}")
    if failure is not None:
        raise failure
    return record


def stages_of(context: StageContext) -> list[Stage]:
    """The stages for a source, in order: of the sub-maps as far as they are known."""
    settings, stages = context.settings, list[Stage]()
    source: dict[str, Any] = {"source": _identity(context.source)}
    if context.data_format is None:
        mask = None if context.mask is None else _identity(context.mask)
        options = {"frames": settings.frames.model_dump(), "mask": mask, **source}
        stages.append(Stage("frames", options, partial(capture_stages.make_frames, context), ["frames"]))
        options = {"diameter": settings.diameter, "sfm": settings.sfm.model_dump()}
        stages.append(Stage("poses", options, partial(capture_stages.make_poses, context), ["poses"], is_plan=True))
        source = {}
    for submap in context.submaps():
        own = {"model": _identity(context.posed / str(submap.submap.model))} if submap.submap.number else source
        stages += _submap_stages(submap, own)
    return stages


def _submap_stages(context: StageContext, source: Mapping[str, Any]) -> list[Stage]:
    """The stages of one sub-map; the first depends on ``source``, as no stage before it does."""
    settings, stages = context.settings, list[Stage]()
    prefix = f"{context.submap.folder}/" if context.submap.folder else ""

    def add(work: Callable[[StageContext], StageOutcome], name: str, options: Mapping[str, Any], *outputs: str) -> None:
        def run() -> StageOutcome:
            made = work(context)
            return replace(made, files={prefix + path: what for path, what in made.files.items()})

        stages.append(Stage(prefix + name, options, run, [prefix + path for path in outputs], context.submap.number))

    size = {"size": settings.size}
    add(capture_stages.check_data, "check", {**size, **source}, "check.html", "check.json")
    if context.estimates_depth:
        depth = {**size, "depth": settings.depth.model_dump()}
        add(capture_stages.estimate_depth, "depth", depth, "depth", ".depth.work")
    method = training_stages.method_for(context)
    load_method(method)  # an unknown method is found out before the work starts
    training = {"method": method, "steps": training_stages.steps_for(context), "seed": settings.seed}
    add(training_stages.train, "train", training, "run")
    add(training_stages.evaluate, "evaluate", {}, "run/eval")
    add(training_stages.mesh, "mesh", {"mesh": settings.mesh.model_dump()}, "run/mesh")
    add(training_stages.coverage, "coverage", {"coverage": settings.coverage.model_dump()}, "run/coverage")
    add(training_stages.show, "scene", {}, "run/scene.html", "run/pictures")
    add(training_stages.report, "report", {}, "report.html")
    return stages


def _refuse_unused(source: Path, settings: ReconstructionSettings, mask: Path | None) -> None:
    """Refuse settings of stages that a scene with poses does not need."""
    unused = {
        "mask": mask is not None,
        "diameter": settings.diameter is not None,
        "frames": settings.frames != FrameSettings(),
        "sfm": settings.sfm != SfmSettings(),
    }
    if given := ", ".join(name for name, is_given in unused.items() if is_given):
        raise InputError(
            f"{source} has poses, and settings of {given} are given",
            "these for a video or a folder of images alone",
            "Leave them out, or give the folder of the scene's images, for their poses to be estimated",
        )


def _identity(path: Path) -> Mapping[str, Any]:
    """Name and size of a file or folder: enough to notice that it is another one."""
    files = sorted(path.iterdir()) if path.is_dir() else [path]
    return {"name": path.resolve().name, "bytes": sum(file.stat().st_size for file in files if file.is_file())}
