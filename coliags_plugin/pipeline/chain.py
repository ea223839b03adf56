"""The stages of a reconstruction in order: those that all sub-maps need, and those of each."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

from coliags_plugin.config.method_config import load_method
from coliags_plugin.pipeline import capture_stages, training_stages
from coliags_plugin.pipeline.context import StageContext
from coliags_plugin.pipeline.stages import Stage, StageOutcome


def stages_of(context: StageContext) -> list[Stage]:
    """The stages for a source, in order: of the sub-maps as far as they are known."""
    settings, stages = context.settings, list[Stage]()
    source: dict[str, Any] = {"source": identity_of(context.source)}
    if context.data_format is None:
        mask = None if context.mask is None else identity_of(context.mask)
        options = {"frames": settings.frames.model_dump(), "mask": mask, **source}
        stages.append(Stage("frames", options, partial(capture_stages.make_frames, context), ["frames"]))
        options = {"diameter": settings.diameter, "sfm": settings.sfm.model_dump()}
        stages.append(Stage("poses", options, partial(capture_stages.make_poses, context), ["poses"], is_plan=True))
        source = {}
    for submap in context.submaps():
        own = {"model": identity_of(context.posed / str(submap.submap.model))} if submap.submap.number else source
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


def identity_of(path: Path) -> Mapping[str, Any]:
    """Name and size of a file or folder: enough to notice that it is another one."""
    files = sorted(path.iterdir()) if path.is_dir() else [path]
    return {"name": path.resolve().name, "bytes": sum(file.stat().st_size for file in files if file.is_file())}
