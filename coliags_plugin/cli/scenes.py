"""Commands that make scenes: ``coliags phantom``, ``depth``, and ``reconstruct`` from a video."""

from __future__ import annotations

import logging
from collections.abc import Iterator
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import tyro

from coliags_plugin.cli.texts import coliags, depth_commands, parse_size, print_summary, train_command, view_command
from coliags_plugin.config import options
from coliags_plugin.core.errors import InputError

if TYPE_CHECKING:
    from coliags_plugin.pipeline.contents import Contents
    from coliags_plugin.pipeline.frame_sources import FrameSource

log = logging.getLogger(__name__)


@dataclass(frozen=True)
class PhantomCommand:
    """Generate a synthetic, physically lit colon with exact ground truth, in the layout of a dataset."""

    output: options.Output
    """Folder to create."""
    seed: int = 0
    """Random seed of the whole phantom."""
    preset: Literal["in-vivo"] | None = None
    """Defaults of all settings: in-vivo looks like the video of a patient, whose wall moves (docs/phantom.md 4)."""
    trajectory: Literal["pullback", "rotation", "inspection", "examination"] | None = None
    """Withdrawal along the lumen (default), mostly rotation in place, a withdrawal that approaches spots of the wall,
    or one back and forth with fast turns."""
    frames: int | None = None
    """Frames of the sequence, 120 by default; every 8th is a test frame."""
    size: options.OptionalText = None
    """Image size WxH, pixels; default: the layout's own, 338x270 for most."""
    light: Literal["c3vd", "strong"] | None = None
    """Preset of light and motion: c3vd is the fair default, strong the stress case."""
    gain: Literal["auto", "fixed"] | None = None
    """Exposure; default: the preset's."""
    rotation_views: int | None = None
    """Extra test views, 12 by default, rotated by 15 to 30 degrees; none in layouts that cannot store them."""
    set: options.Assignments = ()
    """Any other phantom setting, for instance roughness=0.4 (docs/phantom.md 6 says where they are listed)."""
    layout: Annotated[str, tyro.conf.arg(metavar="NAME")] = "c3vd"
    """Files and folders to write (`coliags list phantom_layouts`)."""
    overwrite: options.Overwrite = False
    json: options.AsJson = False

    def run(self) -> None:
        """Generate the dataset."""
        from coliags_plugin.api.scenes import make_phantom
        from coliags_plugin.config.yaml_tree import parse_assignments
        from coliags_plugin.core.registry import phantom_layouts

        names = ("preset", "trajectory", "frames", "light", "gain", "rotation_views")
        values = {name: getattr(self, name) for name in names}
        options: dict[str, Any] = {"seed": self.seed, "layout": self.layout, "overwrite": self.overwrite}
        options |= {name: value for name, value in values.items() if value is not None}
        if self.size is not None:
            options["width"], options["height"] = parse_size(self.size)
        options |= parse_assignments(self.set)
        folder = make_phantom(self.output, **options)
        then = depth_commands(folder) if phantom_layouts.get(self.layout).has_points else [train_command(folder)]
        print_summary(facts={"settings": options}, written=[folder], then=then, as_json=self.json)


@dataclass(frozen=True)
class DepthCommand(options.DepthOptions):
    """Estimate the dense depth of a video with known poses, with its confidence; write it as a scene to train on."""

    json: options.AsJson = False

    def run(self) -> None:
        """Estimate, or resume; write the scene and print a summary."""
        from coliags_plugin.api.scenes import estimate_depth
        from coliags_plugin.config.yaml_tree import assignments

        scene = estimate_depth(self)
        train = train_command(scene.folder, assignments(scene.settings))
        print_summary(scene.summary, written=[scene.folder], then=[train], as_json=self.json)


@dataclass(frozen=True)
class ReconstructCommand(options.ReconstructOptions):
    """Reconstruct a colon from a video alone: frames, poses, depth, training, mesh, coverage and report.

    Each stage is kept: repeated, the command goes on with what is missing, also after a kill.
    """

    camera: options.OptionalText = None
    """A known camera, scaled to the frames (c3vd: whole frames of C3VD; c3vd-undistorted; NAME.xml: of a calibration
    file), or a camera model of COLMAP; default: of the calibration file in the folder, else found from the frames."""
    params: Annotated[options.OptionalText, tyro.conf.arg(metavar="P1,P2,...")] = None
    """Parameters of COLMAP's model, for the frames' size, pixel centres at integers + 0.5; default: estimated."""
    diameter: options.OptionalFloat = None
    """The colon's typical inner diameter, which gives lengths in mm, roughly; default: their unit stays unknown."""
    start: Annotated[options.OptionalText, tyro.conf.arg(name="from", metavar="[H:]M:SS")] = None
    """Time in the video of the first frame, for instance 3:20; default: the beginning."""
    end: Annotated[options.OptionalText, tyro.conf.arg(name="to", metavar="[H:]M:SS")] = None
    """Time of the last frame; default: the end."""
    every: options.OptionalInt = None
    """Use the sharpest of every n frames; default: all."""
    frames_per_second: Annotated[float | None, tyro.conf.arg(metavar="F", help_behavior_hint="")] = None
    """Use about so many frames a second, in place of --every: the sharpest of every n by the video's rate, or of every
    1/F s of a variable one."""
    size: options.OptionalText = None
    """Size WxH of the images that depth is estimated from and training sees, pixels; default: what fits 338x270."""
    method: options.OptionalText = None
    """Method to train; default: coliags-plus."""
    steps: options.OptionalInt = None
    """Training steps of 100 frames, and at least of the largest sub-map; default 2000 (docs/reconstruct.md 1)."""
    json: options.AsJson = False

    def run(self) -> None:
        """Run the stages that are not done, and print what there is."""
        from coliags_plugin.api.scenes import reconstruct
        from coliags_plugin.config.yaml_tree import assignments, parse_assignments
        from coliags_plugin.pipeline.contents import read_contents
        from coliags_plugin.pipeline.stages import PAGE_FILE

        options: dict[str, Any] = {
            "sfm.camera.model": self.camera,
            "sfm.camera.params": None
            if self.params is None
            else parse_assignments([f"params=[{self.params}]"])["params"],
            "diameter": self.diameter,
            **self._frames(),
            "size": None if self.size is None else parse_size(self.size),
            "method": self.method,
            "steps": self.steps,
        }
        settings = {key: value for key, value in options.items() if value is not None}
        record = reconstruct(replace(self, settings=(*assignments(settings), *self.settings)))
        contents = read_contents(self.output, record)
        finished = [submap for submap in contents.submaps if "report" in submap.stages and not submap.failure]
        largest = max(finished, key=lambda submap: len(submap.names))
        print_summary(
            "\n".join(_lines(contents)),
            {"stages": {name: asdict(stage) for name, stage in record.stages.items()}},
            written=[self.output / PAGE_FILE],
            then=[
                view_command(self.output / largest.folder / "run"),
                coliags("poses", "export", self.output, "--output", f"{self.output}-atlas"),
            ],
            as_json=self.json,
        )

    def _frames(self) -> dict[str, Any]:
        """Settings of which frames are used, None where nothing is given."""
        from coliags_plugin.pipeline.frame_sources import frame_source

        if self.every is not None and self.frames_per_second is not None:
            raise InputError("--every and --frames-per-second", "one of them")
        if self.start is None and self.end is None and self.frames_per_second is None:
            return {"frames.every": self.every}
        source = frame_source(self.video)
        first, last = (None if time is None else source.frame_at(seconds_of(time)) for time in (self.start, self.end))
        frames = {"frames.first": first, "frames.last": last, "frames.every": self.every}
        if self.frames_per_second is None:
            return frames
        every, by_time = every_of(source, self.frames_per_second), source.is_variable
        return {**frames, "frames.every": every, "frames.per_second": self.frames_per_second if by_time else None}


def seconds_of(time: str) -> float:
    """Seconds of a time such as ``200``, ``3:20`` or ``1:02:03.5`` (seconds, minutes, hours)."""
    try:
        parts = [float(part) for part in time.split(":")]
        if len(parts) > 3 or min(parts) < 0.0:
            raise ValueError
    except ValueError:
        expected = "seconds, or hours, minutes and seconds such as 3:20 or 1:02:03.5"
        raise InputError(f"the time '{time}'", expected) from None
    return sum(part * 60.0**power for power, part in enumerate(reversed(parts)))


def every_of(source: FrameSource, rate: float) -> int:
    """The n for which one of every n frames gives about ``rate`` frames a second.

    Raises:
        InputError: ``rate`` is no positive number, or the source does not tell how many frames a second it has.
    """
    from coliags_plugin.pipeline.video_files import FASTEST

    if not 0.0 < rate < FASTEST:
        raise InputError(f"--frames-per-second {rate:g}", f"a number between 0 and {FASTEST:g}")
    recorded = source.known_rate
    every = max(1, round(recorded / rate))
    if source.is_variable:
        what = "%s has a variable rate, of %.4g frames a second in the mean: the sharpest of every 1/%.4g s is used"
        log.info(what, source.path, recorded, rate)
    else:
        what = "%s has %.4g frames a second: the sharpest of every %d is used, %.3g a second"
        log.info(what, source.path, recorded, every, recorded / every)
    return every


def _lines(contents: Contents) -> Iterator[str]:
    """Lines of what a video came to: stages and files, segments and joins of a long one, sub-maps, and remarks."""
    from coliags_plugin.pipeline.page import held_out_text, remarks, submap_table, verdicts_text
    from coliags_plugin.reporting.text_formats import terminal_text
    from coliags_plugin.surface.coverage.writing import RESEARCH_USE

    folder, submaps = contents.folder, [submap for submap in contents.submaps if submap.stages]
    stages = {name: stage for name, stage in contents.stages.items() if "/" not in name}
    yield from (f"{name}: {stage.summary}" for name, stage in stages.items())
    yield from (f"{folder / path}: {content}" for stage in stages.values() for path, content in stage.files.items())
    for segment in contents.segments if len(contents.segments) > 1 else ():
        span, poses = segment.span, segment.stages.get("poses")
        outcome = "not begun" if poses is None else poses.summary.partition("\n")[0]
        yield f"{span.name}, frames {span.first} to {span.last}: {outcome}"
    for skipped in contents.video.skipped:
        yield f"frames {skipped.first} to {skipped.last} left out: {skipped.why}"
    for join in contents.joins:
        models = [f"{name}/{Path(model).name}" if model else name for name, model in join.keys]
        yield f"{' and '.join(models)}: {'joined' if join.joined else f'not joined: {join.reason}'}"
    if len(submaps) > 1:
        yield f"geometry of sub-maps: {verdicts_text(contents)}"
        yield from (f"{folder / submap.folder}: {submap.name}, {submap.outcome}" for submap in submaps)
        yield from ("", terminal_text([submap_table(contents)]), "", f"held-out PSNR: {held_out_text(submaps)}")
    yield from remarks(contents)
    yield RESEARCH_USE
