"""The stages of a segment, their context, order and work: those that all its sub-maps need, and those of each."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import cached_property, partial
from pathlib import Path
from typing import Any

import torch

from coliags_plugin.checks.data.check import check_scene
from coliags_plugin.checks.data.page import check_page, verdict
from coliags_plugin.comparison.report.report import write_report
from coliags_plugin.comparison.report.views import evenly
from coliags_plugin.config.method_config import load_method, method_name
from coliags_plugin.config.options import PageOptions, ReportOptions, TrainOptions
from coliags_plugin.core.errors import InputError, InterruptedRunError, NotWritableError
from coliags_plugin.core.files import write_json
from coliags_plugin.core.jobs import Progress
from coliags_plugin.core.scene_files import Unit
from coliags_plugin.core.scenes import Scene
from coliags_plugin.datamanagers.colmap import ATLAS_FILE, find_models
from coliags_plugin.engine import evaluator
from coliags_plugin.engine.data_formats import UNKNOWN_MEDIAN_DEPTH, open_scene
from coliags_plugin.engine.held_light import flatten
from coliags_plugin.engine.rendering import depth_picture, render_view, sampled_depth_limits
from coliags_plugin.engine.run_folder import RunFolder
from coliags_plugin.engine.scoring import Scorer
from coliags_plugin.engine.trained import TrainedRun, load_trained
from coliags_plugin.engine.trainer import open_training
from coliags_plugin.export.viewer.page import save_page
from coliags_plugin.geometry.meshes.mesh import MESH_FORMATS, read_mesh
from coliags_plugin.geometry.poses import colmap
from coliags_plugin.pipeline.contents import read_contents
from coliags_plugin.pipeline.frame_sources import Span, chosen_frames, frame_source
from coliags_plugin.pipeline.frames import IMAGES, read_blurred, read_lens_mask, write_frames
from coliags_plugin.pipeline.settings import FEWEST, ReconstructionSettings
from coliags_plugin.pipeline.stages import Record, Stage, StageRecord, submap_name
from coliags_plugin.pipeline.survey import SURVEY_FILE, Survey, Video, cut, survey_video
from coliags_plugin.pipeline.timeline import with_times
from coliags_plugin.pipeline.verdict import judge, measured_geometry
from coliags_plugin.reconstruction.depth.scene import estimate_scene, training_options
from coliags_plugin.reconstruction.structure import sfm
from coliags_plugin.reconstruction.structure.colmap_scene import write_sfm_scene
from coliags_plugin.reconstruction.structure.image_files import list_images
from coliags_plugin.reporting.colormaps import depth_scale_text
from coliags_plugin.reporting.html_page import write_html
from coliags_plugin.reporting.image_files import eight_bit, write_png
from coliags_plugin.reporting.numbers import area_text, counted
from coliags_plugin.surface.coverage.writing import measure_scene
from coliags_plugin.surface.meshing.fusion import mesh_run

#: Share of the frames below which it is said that the poses are of a part of the video only.
_MOST = 0.7
#: Largest time between two checkpoints, seconds, and the number of checkpoints kept.
_SAVE_SECONDS, _KEPT = 60.0, 2
#: Largest page of a scene: of the largest sub-map and of others. Its Gaussians are fitted for as many steps as
#: were trained, but so many at most; not for a time, so that it is the same whatever machine made it.
_PAGES, _MOST_FIT_STEPS = {True: "10MB", False: "4MB"}, 2000
#: Frames that are shown with their depth.
_PICTURED = 4
#: Training views that are evaluated, for comparison with those held out.
_TRAINING_VIEWS = 16
#: Frames of a sub-map that get the steps of the settings; least share of them, and most (docs/reconstruct.md 5).
_ALL_STEPS, _LEAST_SHARE, _MOST_SHARE = 100, 0.25, 2.0


@dataclass(frozen=True)
class Submap:
    """A model of a scene. The first, number 0, is the largest that structure from motion has found."""

    number: int = 0
    model: str | None = None  # its folder, relative to the scene; None: the only one, which the data manager finds
    frames: int | None = None  # that have a pose in it; None: not counted, as it is the only one

    @property
    def folder(self) -> str:
        """Folder of its results, relative to its segment's; empty for the first."""
        return f"submap-{self.number}" if self.number else ""


def find_submaps(scene: Path, least: int) -> list[Submap]:
    """The first model of a scene in COLMAP's layout, and the others that have ``least`` frames or more."""
    models = [folder for folder in find_models(scene) if folder.name.isdecimal()]
    if len(models) < 2:
        return [Submap()]
    counts = [len(colmap.read(folder).camera_to_world) for folder in models]
    return [
        Submap(number, folder.relative_to(scene).as_posix(), count)
        for number, (folder, count) in enumerate(zip(models, counts, strict=True))
        if number == 0 or count >= least
    ]


@dataclass(frozen=True)
class StageContext:
    """Input of a stage: source, settings, and which segment and sub-map it is of."""

    root: Path  # the reconstruction's folder
    source: Path  # the video, folder of images or scene
    settings: ReconstructionSettings
    mask: Path | None  # image that is black where pixels are ignored; None: found from the frames
    data_format: str | None  # of a source that is a scene; None: it is none
    device: torch.device
    progress: Progress | None = None
    segment: str = ""  # name of the segment's folder; empty: the only one, which lies in the root
    submap: Submap | None = None  # which model of the posed scene is reconstructed; None: what all of them need

    @property
    def prefix(self) -> str:
        """The way from the root to the folder, which names of stages and of files begin with."""
        return "".join(f"{name}/" for name in (self.segment, self.submap and self.submap.folder) if name)

    @property
    def title(self) -> str:
        """Name of the scene on pages: the source, and which sub-map of it."""
        number = None if self.submap is None else self.submap.number
        return ", ".join([self.source.name, *([] if number is None else [submap_name(self.segment, number)])])

    @property
    def places(self) -> list[Path]:
        """Files and folders that were given."""
        return [path for path in (self.source, self.mask) if path is not None]

    def submaps(self) -> list[StageContext]:
        """Contexts of the models that are reconstructed, the largest first, as far as poses are there."""
        is_atlas = self.data_format in (None, "colmap") and self.posed.is_dir()
        models = find_submaps(self.posed, self.settings.least_submap) if is_atlas else [Submap()]
        return [replace(self, submap=submap) for submap in models]

    @property
    def out(self) -> Path:
        """Folder of the segment."""
        return self.root / self.segment

    @property
    def folder(self) -> Path:
        """Folder of the sub-map's results."""
        return self.root / self.prefix

    @property
    def frames(self) -> Path:
        """Frames of use."""
        return self.out / "frames"

    @property
    def posed(self) -> Path:
        """Scene with poses: of structure from motion, or the source."""
        return self.source if self.data_format is not None else self.out / "poses"

    @property
    def run(self) -> Path:
        """The trained run."""
        return self.folder / "run"

    def open_posed(self, stored_size: bool = False) -> Scene:
        """The posed scene at the working size without blurred frames, its images read when they are needed."""
        size = self.settings.size
        options = ["initial_points=none", "keep_pixels=false", *self.model_options]
        options += [] if size is None else [f"width={size[0]}", f"height={size[1]}"]
        options += ["split=inner-8th"] if self.data_format is None else []
        scene = open_scene(self.posed, self.data_format or "colmap", options, self.progress, stored_size)
        scene = scene if self.data_format is not None else scene.without(read_blurred(self.frames))
        return replace(scene, name=self.title)

    @property
    def model_options(self) -> list[str]:
        """Options of the posed scene's data manager: which model is read."""
        return [f"model={self.submap.model}"] if self.submap and self.submap.model else []

    @property
    def scene(self) -> Path:
        """Scene to train on: that with estimated depth, or the source."""
        return self.folder / "depth" if self.estimates_depth else self.posed

    def trained(self) -> TrainedRun:
        """The trained run, its scene under the title of the sub-map."""
        trained = load_trained(self.run, self.device, self.scene)
        return replace(trained, scene=replace(trained.scene, name=self.title))

    @cached_property
    def estimates_depth(self) -> bool:
        """True if depth has to be estimated, as the source is no scene, or one without dense depth."""
        return self.data_format is None or self.open_posed().train[0].depth is None


def stages_of(context: StageContext) -> list[Stage]:
    """The stages of a context, in order: those that all sub-maps of a segment need, or those of one sub-map.

    A scene with poses has none of the former. The first stage of a sub-map depends on what no stage before it does: the
    scene, or the other model.
    """

    def stage(name: str, work: Callable[[StageContext], StageRecord], **options: object) -> Stage:
        return Stage(context.prefix + name, partial(work, context), options)

    settings, submap, is_scene = context.settings, context.submap, context.data_format is not None
    if submap is None:
        mask = None if context.mask is None else identity_of(context.mask)
        before_submaps = [
            stage("frames", make_frames, frames=settings.frames.model_dump(), mask=mask),
            stage("poses", make_poses, diameter=settings.diameter, sfm=settings.sfm.model_dump()),
        ]
        return [] if is_scene else before_submaps
    source: dict[str, object] = {"source": identity_of(context.source)} if is_scene else {}
    if submap.number:
        source = {"model": identity_of(context.posed / str(submap.model))}
    stages = [stage("check", check_data, size=settings.size, **source)]
    if context.estimates_depth:
        stages.append(stage("depth", estimate_depth, size=settings.size, depth=settings.depth.model_dump()))
    load_method(settings.method)  # an unknown method is found out before the work starts
    return [
        *stages,
        stage("train", train, method=settings.method, steps=steps_for(context), seed=settings.seed),
        stage("evaluate", evaluate),
        stage("mesh", mesh, mesh=settings.mesh.model_dump()),
        stage("verdict", judge_geometry),
        stage("coverage", coverage, coverage=settings.coverage.model_dump()),
        stage("scene", show),
        stage("report", report),
    ]


def identity_of(path: Path) -> Mapping[str, Any]:
    """Name and size of a file or folder: enough to notice that it is another one."""
    files = sorted(path.glob("[!.]*")) if path.is_dir() else [path]
    return {"name": path.resolve().name, "bytes": sum(file.stat().st_size for file in files if file.is_file())}


def survey_stage(context: StageContext) -> Stage:
    """The stage before those of all segments."""
    frames = context.settings.frames
    cutting = frames.model_dump(include={"first", "last", "every", "segment", "deinterlace"})
    options: dict[str, Any] = {"source": identity_of(context.source), "frames": cutting}
    if frame_source(context.source, Span(frames.first, frames.last)).expected > frames.segment * frames.every:
        options["least_submap"] = context.settings.least_submap
    return Stage("survey", partial(make_survey, context), options)


def make_survey(context: StageContext) -> StageRecord:
    """Look at every frame of the video once, and cut it into segments."""
    settings = context.settings
    source = chosen_frames(context.source, settings.frames)
    survey = survey_video(source, context.progress)
    survey.write(context.root)
    segments, skipped = cut(survey, settings.frames, settings.least_submap)
    height, width = survey.size
    video = Video(
        source=source.path.name,
        rate=source.rate,
        frames=len(survey),
        size=(width, height),
        first=source.span.first,
        deinterlace=source.span.deinterlace,
        segments=tuple(segments),
        skipped=tuple(skipped),
    )
    summary = f"{counted(video.frames, 'frame')} in {counted(len(segments), 'segment')}"
    files = {SURVEY_FILE: "sharpness and motion of every frame"}
    return StageRecord(summary, files, figures=video.model_dump(mode="json"))


def make_frames(context: StageContext) -> StageRecord:
    """Write the frames of use, and their mask, by the survey of the video."""
    settings = context.settings.frames
    span = Span(settings.first, settings.last, settings.deinterlace)
    source, survey = frame_source(context.source, span), Survey.read(context.root).part(span.first, span.last)
    summary = write_frames(source, survey, context.frames, settings, context.mask, context.progress)
    files = {"frames/images": "frames of use, PNG", "frames/frames.json": "which frames were dropped, and why"}
    return StageRecord(summary, files)


def make_poses(context: StageContext) -> StageRecord:
    """Estimate poses and points by structure from motion, and write them as a scene."""
    settings = context.settings
    mask = read_lens_mask(context.frames)
    atlas = sfm.reconstruct(list_images(context.frames / IMAGES), settings.sfm, mask, context.progress)
    largest, count = atlas.largest, len(atlas.images)
    if len(largest.registered) < FEWEST:
        raise InputError(
            f"{len(largest.registered)} of {count} frames have poses",
            f"at least {FEWEST}",
            "Choose a part of the video in which the camera moves along tissue that it sees well, keep more frames "
            "(`every`), or give the camera (`camera`)",
        )
    warnings = []
    if (posed := count - len(atlas.lost)) < _MOST * count:
        warnings.append(f"{posed} of {count} frames have a pose: poses/{ATLAS_FILE} says why the others have none")
    used = [model for model in atlas.models if model is largest or len(model.registered) >= settings.least_submap]
    factors = [sfm.millimetres(model, settings.diameter) for model in used]
    models = [
        sfm.scaled(model, factor or UNKNOWN_MEDIAN_DEPTH / model.median_depth)
        for model, factor in zip(used, factors, strict=True)
    ]
    atlas = replace(atlas, models=(*models, *atlas.models[len(used) :]))
    units: list[Unit] = ["unknown" if factor is None else "mm" for factor in factors]
    write_sfm_scene(context.posed, atlas, mask, overwrite=True, units=units, link=True)
    depth = atlas.largest.median_depth
    unit = (
        f"unit of length unknown (`diameter` gives one): the median depth is made {UNKNOWN_MEDIAN_DEPTH:g}"
        if units[0] == "unknown"
        else f"unit mm, by a diameter of {settings.diameter:g} mm; median depth {depth:.3g} mm"
    )
    files = {"poses": "scene in COLMAP's layout: images, poses, points"}
    return StageRecord(f"{atlas.summary()}; {unit}", files, warnings)


def check_data(context: StageContext) -> StageRecord:
    """Check that images, poses and calibration agree. What is suspect is said, and does not stop."""
    scene = context.open_posed()
    check = check_scene(
        scene, context.progress, (lambda: context.open_posed(stored_size=True)) if scene.is_resized else None
    )
    write_html(check_page(check), context.folder / "check.html")
    write_json(context.folder / "check.json", check.as_json())
    files = {"check.html": "consistency of images, poses and calibration", "check.json": "the same as JSON"}
    warnings = [str(finding) for finding in check.findings]
    return StageRecord(verdict(check), files, warnings, {"frames": len(scene.video)})


def estimate_depth(context: StageContext) -> StageRecord:
    """Estimate dense depth with its confidence; goes on where a kill has left it."""
    summary, warnings, confident = estimate_scene(
        context.open_posed(), context.scene, context.settings.depth, overwrite=True, progress=context.progress
    )
    files = {"depth": "scene in nerfstudio's layout: images, poses, depth, confidence, points"}
    return StageRecord(summary, files, warnings, {"confident": confident})


def steps_for(context: StageContext) -> int:
    """Training steps: in proportion to the sub-map's frames, for the largest not below those of the settings."""
    steps, submap = context.settings.steps, context.submap
    if submap is None or submap.frames is None:
        return steps
    least = 1.0 if submap.number == 0 else _LEAST_SHARE
    return max(1, round(steps * min(_MOST_SHARE, max(least, submap.frames / _ALL_STEPS))))


def train(context: StageContext) -> StageRecord:
    """Train, or go on from the newest checkpoint."""
    settings = context.settings
    options = training_options(context.open_posed())
    data_format = None if context.estimates_depth else context.data_format
    if not context.estimates_depth:
        options = [*options, *(f"datamanager.{option}" for option in context.model_options)]
    training = TrainOptions(
        settings.method,
        context.scene,
        steps=steps_for(context),
        seed=settings.seed,
        settings=tuple(options),
        data_format=data_format,
    )
    folder = RunFolder(context.run)
    with open_training(training, folder, context.device, "continue") as trainer:
        try:
            trainer.train(_SAVE_SECONDS, _KEPT)
        except InterruptedRunError as error:
            raise InterruptedRunError(
                f"stopped after step {trainer.step} of {trainer.steps}, which is saved; the same command goes on from "
                "there"
            ) from error
    rows = folder.log_rows()
    last = f", {rows[-1]['psnr']:.2f} dB in the last view" if rows else ""
    summary = f"{method_name(training.method)}, {trainer.steps} steps{last}"
    return StageRecord(summary, {"run": "the trained run"}, figures={"steps": trainer.steps})


def evaluate(context: StageContext) -> StageRecord:
    """Evaluate the held-out frames."""
    trained = context.trained()
    result = evaluator.evaluate(trained, trained.config.protocol, refine_poses=True)
    folder = trained.run.evaluations / result.evaluation_name
    means = {name: result.sets[result.main_set].mean(name) for name in ("psnr", "ssim", "psnr_pose_refined")}
    figures = {name: value for name, value in means.items() if value is not None}
    shown = ", ".join(f"{name.upper()} {figures[name]:.4g}" for name in ("psnr", "ssim") if name in figures)
    files = {str(folder.relative_to(context.folder)): "metrics and rendered frames"}
    figures |= {"held_out": sum(len(frames) for frames in trained.scene.test_sets.values()), **_training_psnr(trained)}
    differences = {"gap": "psnr_training", "pose_gain": "psnr_pose_refined"}
    figures |= {name: figures[other] - figures["psnr"] for name, other in differences.items() if other in figures}
    warnings = [f"held-out frames: {part.transparency_warning}" for part in result.sets.values() if part.blank]
    return StageRecord(f"held-out frames: {shown}", files, warnings, figures=figures)


def _training_psnr(trained: TrainedRun) -> dict[str, float]:
    """Mean PSNR of at most 16 training views, as the protocol has it; empty where it has none."""
    scorer, frames, values = Scorer(trained.config.protocol, ["psnr"]), trained.scene.train, list[float]()
    for index in evenly(len(frames), _TRAINING_VIEWS):
        frame = frames[index].to(trained.device)
        output = trained.model.render(frame.camera, scorer.wants, frame.view(trained=True))
        values += scorer.score(scorer.protocol.compare(output, frame)).values.values()
    return {"psnr_training": sum(values) / len(values)} if values else {}


def mesh(context: StageContext) -> StageRecord:
    """Fuse the rendered depth into a mesh."""
    trained = context.trained()
    fused = mesh_run(trained, context.run / "mesh", context.settings.mesh, overwrite=True)
    area = fused.mesh.areas.sum()
    shown = area_text(area, trained.scene.is_metric)
    files = {f"run/mesh/mesh.{kind}": f"the surface as {kind.upper()}" for kind in MESH_FORMATS}
    figures = {"triangles": len(fused.mesh), "area": float(area), "unit": trained.scene.length_unit}
    return StageRecord(f"{len(fused.mesh):,} triangles, {shown}", files, figures=figures)


def judge_geometry(context: StageContext) -> StageRecord:
    """Judge the geometry by what earlier stages have measured, the agreement of views, and the parts of the mesh."""
    stages = Record.of(context.root).stages
    before = (
        stages[context.prefix + step] for step in ("check", "depth", "evaluate") if context.prefix + step in stages
    )
    figures = {name: value for stage in before for name, value in stage.figures.items()}
    geometry = measured_geometry(context.trained(), read_mesh(context.run / "mesh" / "mesh.ply"))
    word, reasons = judge(figures | geometry)
    summary = word if word == "usable" else f"{word}: {'; '.join(reasons)}"
    return StageRecord(summary, figures=geometry | {"verdict": word, "reasons": reasons})


def coverage(context: StageContext) -> StageRecord:
    """Measure the share of the wall seen in the video; left out where it cannot be measured, or is no surface."""
    if Record.of(context.root).stages[f"{context.prefix}verdict"].figures.get("verdict") == "not usable":
        return StageRecord("left out: the geometry is not usable")
    wall, folder = read_mesh(context.run / "mesh" / "mesh.ply"), context.run / "coverage"
    try:
        measured = measure_scene(context.open_posed(), wall, folder, context.settings.coverage, overwrite=True)
    except NotWritableError:
        raise
    except InputError as error:
        return StageRecord(f"left out: {error}", warnings=[f"no coverage: {error}"])
    what = "what was seen and missed"
    values = measured.values
    return StageRecord(
        "; ".join(f"{fact.name}: {fact.text}" for fact in measured.facts),
        {"run/coverage/coverage.html": what, "run/coverage/coverage.ply": "the same on the mesh"},
        figures={name: values[name] for name in ("seen", "seen_area") if values[name] is not None},
    )


def show(context: StageContext) -> StageRecord:
    """Write the page of Gaussians and meshes along the path of the video, and pictures of some of its frames."""
    trained = context.trained()
    depth_scale = _write_pictures(trained, context.run / "pictures")
    size, steps = _PAGES[context.folder == context.out], min(trained.step, _MOST_FIT_STEPS)
    label = partial(with_times, read_contents(context.root))
    page = save_page(trained, PageOptions(size=size, seconds=math.inf), steps, label)
    what = "the scene to fly through: Gaussians, surface, coverage"
    files = {"run/scene.html": what, "run/pictures": "frames, depth, flattened light"}
    return StageRecord(page.text, files, figures={"depth_scale": depth_scale})


def _write_pictures(trained: TrainedRun, folder: Path) -> str:
    """Write some frames of the video, as recorded, their depth, and in flattened light where colours know the lamp.

    Returns what the colours of depth mean.
    """
    flat = flatten(trained) if trained.model.field.knows_lamp else None
    depth, video, scale = "depth_expected", trained.scene.video, ""
    if depth in trained.model.outputs:
        limits = sampled_depth_limits(trained, video, depth)
        scale = depth_scale_text(limits, trained.scene.length_unit)
    for index in evenly(len(video), _PICTURED):
        frame = video[index]
        write_png(folder / frame.name / "recorded.png", frame.image)
        if scale:
            output = render_view(trained, frame, ("rgb", "alpha", depth))
            write_png(folder / frame.name / "depth.png", depth_picture(output, depth, limits))
        if flat is not None:
            write_png(folder / frame.name / "flattened light.png", eight_bit(render_view(flat, frame).rgb))
    return scale


def report(context: StageContext) -> StageRecord:
    """Write the report of the run."""
    protocol = RunFolder(context.run).method().config.protocol
    title = f"Reconstruction of {context.source.name}"
    options = ReportOptions(context.folder / "report.html", title=title, protocol=protocol, overwrite=True)
    write_report([context.run], options)
    return StageRecord("report.html", {"report.html": "views, metrics, training, provenance"})
