"""Options of operations, a class for each: the command line makes flags of their fields, the Python API keywords."""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import dataclass
from functools import wraps
from inspect import getdoc, signature
from pathlib import Path
from typing import Annotated, Any, Literal, TypeVar, get_origin, get_type_hints

import tyro

from coliags_plugin.config.yaml_tree import assignments
from coliags_plugin.core.errors import InputError
from coliags_plugin.core.files import user_path

R = TypeVar("R")


def _flag(metavar: str | None = None, **more: Any) -> Any:
    """Return the description for tyro of a flag, or of an option whose help says what is done without it."""
    return tyro.conf.arg(metavar=metavar, help_behavior_hint="", **more)


OptionalPath = Annotated[Path | None, _flag("PATH")]
OptionalText = Annotated[str | None, _flag("TEXT")]
OptionalInt = Annotated[int | None, _flag("INT")]
OptionalFloat = Annotated[float | None, _flag("MM")]
#: What is done by default, and left out by the flag ``--no-NAME``, which its help describes.
DoneByDefault = Annotated[bool, _flag()]
Names = Annotated[tuple[str, ...], _flag("NAME...")]

#: ``--output`` or ``-o``: the one spelling of where a command writes.
Output = Annotated[Path, tyro.conf.arg(aliases=("-o",), metavar="PATH")]
OptionalOutput = Annotated[Path | None, _flag("PATH", aliases=("-o",))]
#: ``--set key=value``, repeatable; in Python a mapping.
Assignments = Annotated[tuple[str, ...], tyro.conf.arg(name="set", metavar="KEY=VALUE"), tyro.conf.UseAppendAction]

Method = Annotated[tyro.conf.Positional[str], tyro.conf.arg(metavar="METHOD")]
RunFolder = Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="RUN", help="Run folder.")]
SceneFolder = Annotated[Path, tyro.conf.arg(help="The scene's folder.")]
_FORMAT_HELP = "Dataset format (`coliags list datamanagers`); default: recognised from the files."
#: Name of a data manager; None: recognised from the files.
DataFormat = Annotated[str | None, _flag("NAME", help=_FORMAT_HELP)]
MovedData = Annotated[Path | None, _flag("PATH", help="The scene's folder, where it has moved since training.")]
Device = Annotated[
    str, tyro.conf.arg(metavar="auto|cpu|cuda|cuda:N", help="Device to compute on; cuda is the first CUDA device.")
]
Overwrite = Annotated[bool, tyro.conf.arg(help="Replace the output where it exists.")]
AsJson = Annotated[bool, tyro.conf.arg(help="Print the summary as JSON.")]

#: Format of a file of Gaussians, and its suffix.
SplatFormat = Literal["ply", "spz", "glb"]
#: Light of Gaussians for all views.
Light = Literal["recorded", "mean", "flattened"]


def takes(kind: type) -> Callable[[Callable[..., R]], Callable[..., R]]:
    """Let a function of ``options`` be called with the fields of their class too, which its help shows."""

    def decorate(function: Callable[..., R]) -> Callable[..., R]:
        parameters = signature(function).parameters
        before = list(parameters).index("options")

        @wraps(function)
        def call(*positional: Any, **named: Any) -> R:
            if len(positional) > before and isinstance(positional[before], kind):
                return function(*positional, **named)
            others = {name: named.pop(name) for name in parameters if name in named}
            return function(*positional[:before], options=kind(*positional[before:], **named), **others)

        shown = [*parameters.values()]
        shown[before : before + 1] = signature(kind).parameters.values()
        vars(call)["__options__"] = kind
        vars(call)["__signature__"] = signature(function).replace(parameters=shown)
        call.__doc__ = f"{getdoc(function)}\n\n{getdoc(kind)}"
        return call

    return decorate


class Options:
    """Base class of options: paths may be given as texts, settings as a mapping, and tuples as a list or one value."""

    def __post_init__(self) -> None:
        types = get_type_hints(type(self))
        for name, value in vars(self).items():
            if types[name] in (Path, Path | None) and isinstance(value, (str, Path)):
                object.__setattr__(self, name, user_path(value))
            elif name == "method" and not isinstance(value, (str, type(None))):
                from coliags_plugin.config.method_config import method_text  # which needs NumPy

                object.__setattr__(self, name, method_text(value))
            elif name == "settings" and not isinstance(value, tuple):
                object.__setattr__(self, name, assignments(value))
            elif get_origin(types[name]) is tuple and not isinstance(value, tuple):
                object.__setattr__(self, name, (value,) if isinstance(value, (str, Path)) else tuple(value))


@dataclass(frozen=True)
class TrainOptions(Options):
    """Options of training a method on a scene.

    Args:
        method: Name of a method (`coliags list methods`) or path of a YAML file; in Python also a mapping like one.
        output: Run folder; default runs/SCENE/METHOD/STAMP.
        steps: Training steps; schedules are scaled to them. A resumed run keeps its own unless given.
        seed: Seed of all random generators; default 0, for a resumed run its own.
        renderer: Renderer by name (`coliags list renderers`); default: the method's.
        resume: Continue from the run's latest checkpoint (without an output: the newest run of this method on this
            scene).
        loggers: Also log to tensorboard or wandb, into the run folder (extra `loggers`).
        settings: Change a value of the method config, for instance field.voxel_size=1.0.
    """

    method: Method
    data: SceneFolder
    output: OptionalOutput = None
    steps: OptionalInt = None
    seed: OptionalInt = None
    renderer: OptionalText = None
    resume: bool = False
    loggers: Names = ()
    settings: Assignments = ()
    data_format: DataFormat = None
    overwrite: Overwrite = False
    device: Device = "auto"

    @property
    def overrides(self) -> tuple[str, ...]:
        """Changes of the method config as ``key.path=value``, those by options of their own last."""
        named = {"schedule.steps": self.steps, "renderer.name": self.renderer}
        return (*self.settings, *assignments({key: value for key, value in named.items() if value is not None}))


@dataclass(frozen=True)
class ImportOptions(Options):
    """Options of importing a file of Gaussians as a run.

    Args:
        file: PLY (3DGS's attributes; 2DGS's, without scale_2) or SPZ, in the world frame and unit of the scene.
        output: Run folder; default runs/SCENE/imported/STAMP.
    """

    file: tyro.conf.Positional[Path]
    data: SceneFolder
    output: OptionalOutput = None
    data_format: DataFormat = None
    overwrite: Overwrite = False
    device: Device = "auto"


@dataclass(frozen=True)
class EvaluateOptions(Options):
    """Options of evaluating a run.

    Args:
        protocol: Protocol by name (`coliags list protocols`); default: the method config's.
        truth: A scene of the same frames and poses with true depth, to evaluate against instead of the run's own, for
            runs trained on estimated depth; results go into eval/PROTOCOL-truth.
        refine_poses: Also measure views from poses refined on the held-out images themselves, as psnr_pose_refined
            (docs/protocols.md); not comparable with psnr.
    """

    protocol: OptionalText = None
    truth: OptionalPath = None
    refine_poses: bool = False


@dataclass(frozen=True)
class RenderOptions(Options):
    """Options of rendering a run to images and video.

    Args:
        output: Folder to create; default RUN/renders, in another light RUN/relit, along a path RUN/path.
        frames: Sets of frames: train, all, or test sets by name (default: test); or single frames by name, no video.
        along: Render only a video along this camera path, a file saved in `coliags view`.
        video: Also write trajectory.mp4, rgb beside depth.
        fps: Frames per second of the video.
        depth_kind: Which depth: sum w z, the paper's; the same divided by alpha; or that of the Gaussian at which half
            of the light is absorbed. Pictures are hatched where alpha is below 0.5.
        depth_tiff: Also write depth as float32 TIFF, scene units: depth_tiff/.
        channels: Also write feature channels of the method's Gaussians, for instance albedo.
    """

    output: OptionalOutput = None
    frames: Names = ("test",)
    along: Annotated[OptionalPath, tyro.conf.arg(name="path")] = None
    video: Annotated[bool, _flag(help="Do not write trajectory.mp4, rgb beside depth.")] = True
    fps: float = 15.0
    depth_kind: Literal["accumulated", "expected", "median"] = "expected"
    depth_tiff: bool = False
    channels: Names = ()
    overwrite: Overwrite = False


@dataclass(frozen=True)
class MeshOptions(Options):
    """Options of making a mesh of a run.

    Args:
        output: Folder to create; default RUN/mesh.
        voxel: Edge of a voxel in scene units (mm); default: two training pixels on the surface.
        color: Colours: as the views show them, each under its lamp; or under one distance and angle to the lamp
            everywhere, the medians of what the training views see, for methods of Gaussians.
        texture: OBJ, with MTL and PNG, and GLB with a texture in place of colours at vertices: four texels along the
            edge of a voxel.
        truth: True surface to compare with: a mesh in the world of the scene, mm, or the folder of a scene with one;
            default: that of the scene, where there is one.
        settings: Another option of meshing (docs/meshes.md 3), for instance depth=median.
        formats: Formats of the mesh.
    """

    output: OptionalOutput = None
    voxel: OptionalFloat = None
    color: Literal["plain", "flattened"] = "plain"
    texture: bool = False
    truth: OptionalPath = None
    settings: Assignments = ()
    formats: Annotated[tuple[Literal["ply", "obj", "glb"], ...], tyro.conf.arg(name="format")] = ("ply", "obj", "glb")
    overwrite: Overwrite = False


@dataclass(frozen=True)
class ExportOptions(Options):
    """Options of exporting the Gaussians of a run, baked where their colours depend on the view.

    Args:
        output: File to write; default RUN/export/SCENE.FORMAT. The record is FILE.json. Of several formats, each has
            its own suffix.
        light: Light baked into colours that depend on the lamp. recorded: the lamp of each training camera, averaged;
            mean: a lamp at the mean training camera; flattened: the same distance and angle everywhere.
        seconds: Time limit, seconds, of the fit of baked Gaussians to the run's renderings, done where baking loses
            much.
        measure: Compare each file with the run on the held-out views, for the record and the terminal.
        formats: Formats, all of one baking (docs/export.md 1). Lengths stay those of the scene (mm).
    """

    output: OptionalOutput = None
    light: Light = "mean"
    seconds: float = 180.0
    measure: Annotated[
        bool,
        _flag(help="Do not compare each file with the run on the held-out views, for the record and the terminal."),
    ] = True
    formats: Annotated[tuple[SplatFormat, ...], tyro.conf.arg(name="format")] = ("ply",)
    overwrite: Overwrite = False


@dataclass(frozen=True)
class PageOptions(Options):
    """Options of the page of a scene that opens offline.

    Args:
        output: Write the scene to this file instead, as a self-contained HTML page, which opens offline.
        size: Of the page, at most, for instance 20MB.
        light: Of the page, as in `coliags export`.
        seconds: Time limit, seconds, of the fit of the page's Gaussians to the run's renderings.
    """

    output: OptionalOutput = None
    size: str = "5MB"
    light: Light = "recorded"
    seconds: float = 180.0

    @property
    def largest(self) -> int:
        """The size, bytes."""
        return bytes_of(str(self.size))


@dataclass(frozen=True)
class CoverageOptions(Options):
    """Options of measuring coverage.

    Args:
        output: Folder to create; default RUN/coverage.
        mesh: The wall, PLY, OBJ or GLB, in the world and unit of the poses; default: RUN/mesh/mesh.ply, or else the
            fused depth of the run.
        settings: An option, for instance region_diameter=10 (docs/coverage.md).
    """

    output: OptionalOutput = None
    mesh: OptionalPath = None
    settings: Assignments = ()
    overwrite: Overwrite = False


@dataclass(frozen=True)
class CompareOptions(Options):
    """Options of a comparison: its scenes, its runs, and where they are done.

    Args:
        scenes: Benchmarks (`coliags list benchmarks`), BENCHMARK/SCENE, paths of benchmark files, or folders of scenes.
        output: Folder of the comparison; one that is there is extended.
        seeds: Runs of every method on every scene, with the seeds 0, 1, ...
        protocol: Evaluation protocol (`coliags list protocols`).
        steps: Training steps of all runs; default: each method's own.
        splits: Splits, each trained apart, for instance every-8th block; default: the scene's own.
        reference: Reference method of the statistical tests in reports, fixed before the first run; only for a new
            folder.
        primary: Metrics decided likewise; in reports, p-values of others are exploratory and have no stars.
        jobs: Runs at a time; default: one per CPU, or per GPU.
        threads: CPU threads of each run; default: the CPUs divided by the runs at a time.
        executor: Where the runs are: processes on this machine, or on a Ray cluster (`pip install
            "coliags_plugin[sweep]"`).
        ray_address: HOST:PORT of the Ray cluster's head; default: RAY_ADDRESS, or the cluster of this machine.
        retries: How often a run is resumed whose process was killed or crashed.
        settings: Change a value of every method config, as for train.
        data: Folder of the benchmark's scenes; default scenes/BENCHMARK. Phantoms that are missing are made there.
    """

    scenes: Annotated[tuple[str, ...], tyro.conf.arg(metavar="SCENE...")]
    output: Output = Path("comparison")
    seeds: int = 1
    protocol: str = "paper"
    steps: OptionalInt = None
    splits: Names = ()
    reference: OptionalText = None
    primary: Names = ()
    jobs: OptionalInt = None
    threads: OptionalInt = None
    executor: Annotated[str, tyro.conf.arg(metavar="local|ray")] = "local"
    ray_address: OptionalText = None
    retries: int = 2
    settings: Assignments = ()
    data: OptionalPath = None
    device: Device = "auto"


@dataclass(frozen=True)
class ReportOptions(Options):
    """Options of a report.

    Args:
        output: File to write; with several formats, its suffix is replaced by that of each; default: report.html, .md,
            ...
        methods: Methods to show, in this order; default: all. Tests count the others too.
        columns: Metrics to show, or all; default: psnr psnr_gain_fitted ssim lpips depth_mse depth_mse_inner
            depth_median_error.
        reference: Method that the others are compared with; default: coliags, or the best where it is not there.
        protocol: Evaluation protocol to read; NAME-truth: evaluations by `coliags eval RUN --truth SCENE`.
        frames: Held-out frames to show per scene and test set; the worst ones are added.
        title: Heading; default: methods and scenes.
        note: A remark shown at the top.
        scene: Run folder whose scene the HTML page lets its reader fly through, offline; needs the extra `viewer`.
        formats: Files to write: html, markdown, latex (booktabs), csv (every frame), json (tables) or all of them;
            text: print the tables.
    """

    output: OptionalOutput = None
    methods: Names = ()
    columns: Names = ()
    reference: OptionalText = None
    protocol: str = "paper"
    frames: int = 2
    title: OptionalText = None
    note: OptionalText = None
    scene: OptionalPath = None
    formats: Annotated[
        tuple[Literal["html", "markdown", "latex", "csv", "json", "all", "text"], ...], tyro.conf.arg(name="format")
    ] = ("html",)
    overwrite: Overwrite = False


@dataclass(frozen=True)
class CheckDataOptions(Options):
    """Options of checking a scene.

    Args:
        scene: The scene's folder.
        html: Also write an HTML page with images and the trajectory.
        settings: An option of the data manager, for instance split=block.
    """

    scene: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="SCENE")]
    html: OptionalPath = None
    settings: Assignments = ()
    data_format: DataFormat = None


@dataclass(frozen=True)
class DepthOptions(Options):
    """Options of estimating the depth of a scene.

    Args:
        scene: The scene's folder. Depth that it has is ignored.
        output: Folder to create, in nerfstudio's layout.
        prior: Folder of depth maps by image name (16-bit .png, .tiff, .npy, .exr), any unit, in place of brightness.
        near: Nearest depth, in the scene's unit of length, with the farthest; default: found from features.
        far: Farthest depth.
        jobs: Number of threads; default: one for each core.
        settings: Option of the data manager, as width=675, or of estimation, as depth.agreement=0.01 (docs/depth.md).
    """

    scene: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="SCENE")]
    output: Output
    prior: OptionalPath = None
    near: Annotated[float | None, _flag("LENGTH")] = None
    far: Annotated[float | None, _flag("LENGTH")] = None
    jobs: OptionalInt = None
    settings: Assignments = ()
    data_format: DataFormat = None
    overwrite: Overwrite = False


@dataclass(frozen=True)
class PosesOptions(Options):
    """Options of estimating the poses of a video.

    Args:
        frames: Video, folder of one with its calibration, or folder of images ordered by the numbers in their names.
        output: Folder to create, in COLMAP's layout.
        camera: A known camera, scaled to the images (c3vd: whole frames of C3VD; c3vd-undistorted; NAME.xml: of a
            calibration file), or a camera model of COLMAP, for instance PINHOLE or OPENCV_FISHEYE; default: of the
            calibration file in the folder, else the better of SIMPLE_RADIAL_FISHEYE and SIMPLE_RADIAL.
        params: Parameters of COLMAP's model, pixel centres at integers + 0.5, kept fixed; default: estimated.
        diameter: The colon's typical inner diameter, which fixes the scale roughly; default: the scale stays unknown.
        distance: Names of two images and the known distance between their cameras, which fixes the scale.
        mask: Mask image, black where pixels are ignored, or a folder with one per image; default: black surroundings
            and overlays are found, of images of one size.
        every: Use every n-th image.
        max_frames: Use at most the first n images.
        settings: An option of matching or mapping, for instance exhaustive_up_to=80 or features.max_features=2000.
    """

    frames: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="FRAMES")]
    output: Output
    camera: OptionalText = None
    params: Annotated[OptionalText, tyro.conf.arg(metavar="P1,P2,...")] = None
    diameter: OptionalFloat = None
    distance: Annotated[tuple[str, str, float] | None, _flag("IMAGE IMAGE MM")] = None
    mask: OptionalPath = None
    every: int = 1
    max_frames: OptionalInt = None
    settings: Assignments = ()
    overwrite: Overwrite = False


@dataclass(frozen=True)
class ReconstructOptions(Options):
    """Options of a reconstruction: its source, its stages, and where they are done.

    Args:
        video: Video file, folder of one with its calibration, folder of images ordered by the numbers in their names,
            or folder of a scene with poses.
        output: Folder of the results.
        mask: Image of the frames' size, black where pixels are ignored; default: black surroundings are found.
        executor: Have sub-maps done at the same time, by processes of this machine or of a Ray cluster; default: one
            after the other, unless a number of jobs is given.
        jobs: Processes at a time; default: one per CPU, or per GPU.
        threads: CPU threads of each process; default: the CPUs divided by the processes at a time.
        ray_address: Head of the Ray cluster; default: RAY_ADDRESS, or the cluster of this machine.
        settings: Any setting of a stage, for instance frames.least_motion=0, sfm.max_ratio=0.9 or depth.agreement=0.03
            (docs/reconstruct.md).
        overwrite: Repeat the stages that were made with other options, and what follows them.
    """

    video: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="VIDEO")]
    output: Output
    mask: OptionalPath = None
    executor: Annotated[OptionalText, tyro.conf.arg(metavar="local|ray")] = None
    jobs: OptionalInt = None
    threads: OptionalInt = None
    ray_address: Annotated[OptionalText, tyro.conf.arg(metavar="HOST:PORT")] = None
    settings: Assignments = ()
    overwrite: bool = False
    device: Device = "auto"


#: Bytes of a unit.
_UNITS = {"": 1, "b": 1, "kb": 10**3, "mb": 10**6, "gb": 10**9}


def bytes_of(text: str) -> int:
    """A size such as ``20MB`` in bytes; units are powers of 1000."""
    match = re.fullmatch(r"\s*(\d+(?:\.\d+)?)\s*([kMG]?B?)\s*", text, re.IGNORECASE)
    unit = match and match[2].lower()
    if match is None or unit not in _UNITS:
        raise InputError(f"`size={text}`", "a size in bytes, kB, MB or GB, for instance 20MB")
    return int(float(match[1]) * _UNITS[unit])
