"""``coliags poses``: its subcommands, which convert, align, export or estimate camera poses."""

from __future__ import annotations

import logging
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import tyro

from coliags_plugin.cli.texts import depth_commands, parse_size, print_summary
from coliags_plugin.config import options
from coliags_plugin.core.errors import InputError

if TYPE_CHECKING:
    from coliags_plugin.core.intrinsics import Intrinsics
    from coliags_plugin.geometry.poses.alignment import Alignment
    from coliags_plugin.geometry.poses.formats import Format
    from coliags_plugin.geometry.poses.trajectory import Trajectory

_LOG = logging.getLogger(__name__)


@dataclass(frozen=True)
class PosesSfmCommand(options.PosesOptions):
    """Estimate poses, intrinsics and surface points from a video's images alone; write them as a scene."""

    json: options.AsJson = False

    def run(self) -> None:
        """Reconstruct, write the scene and print a summary."""
        from coliags_plugin.api.scenes import estimate_poses

        scene = estimate_poses(self)
        print_summary(scene.summary, written=[self.output], then=depth_commands(self.output), as_json=self.json)


OptionalFormat = Annotated[str | None, tyro.conf.arg(metavar="FORMAT")]


def read_and_log(path: Path, name: str | None) -> tuple[Format, Trajectory]:
    """Read poses and log format, path length and direction, which reveal a wrong convention."""
    from coliags_plugin.geometry.poses.formats import format_of

    kind = format_of(path, name)
    trajectory = kind.read(path)
    _LOG.info("%s: %s (%s); %s", path, kind.name, trajectory.stored_as, trajectory.summary(kind.unit))
    for remark in trajectory.remarks:
        _LOG.info("%s: %s", path, remark)
    return kind, trajectory


def parse_intrinsics(intrinsics: str | None, size: str | None) -> Intrinsics | None:
    """``fx,fy,cx,cy`` and ``WxH`` -> intrinsics; None where neither is given."""
    from coliags_plugin.core.intrinsics import Intrinsics
    from coliags_plugin.geometry.poses.formats import prefixed_errors

    if intrinsics is None or size is None:
        if intrinsics != size:
            raise InputError("--intrinsics without --size, or the reverse", "both or neither")
        return None
    try:
        fx, fy, cx, cy = (float(part) for part in intrinsics.split(","))
    except ValueError as error:
        raise InputError(f"--intrinsics {intrinsics}", "four numbers fx,fy,cx,cy in pixels") from error
    with prefixed_errors("--intrinsics, --size"):
        return Intrinsics(fx, fy, cx, cy, *parse_size(size))


@dataclass(frozen=True)
class PosesConvertCommand:
    """Write poses in another format (c3vd, tum, endogslam, colmap, colmap-text, nerfstudio)."""

    input: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="IN")]
    """File with poses, or the folder of a COLMAP model."""
    output: options.Output
    """File to write; for COLMAP, folder to create."""
    to: Annotated[str, tyro.conf.arg(metavar="FORMAT")]
    """Format to write."""
    intrinsics: Annotated[options.OptionalText, tyro.conf.arg(metavar="FX,FY,CX,CY")] = None
    """Pinhole intrinsics of all images, px, pixel centres at integers + 0.5; default: the input's."""
    size: Annotated[options.OptionalText, tyro.conf.arg(metavar="WxH")] = None
    """Image size, px; with --intrinsics."""
    images: options.OptionalPath = None
    """Folder whose images, in natural order, give the poses their names; default: the input's names."""
    from_format: Annotated[OptionalFormat, tyro.conf.arg(name="from")] = None
    """Format of the input; default: recognised from its content."""
    overwrite: options.Overwrite = False
    json: options.AsJson = False

    def run(self) -> None:
        """Convert the poses."""
        from coliags_plugin.geometry.poses.formats import format_named, write_trajectory

        target = format_named(self.to)
        pinhole = parse_intrinsics(self.intrinsics, self.size)
        _, trajectory = read_and_log(self.input, self.from_format)
        if self.output.exists() and self.output.samefile(self.input):
            raise InputError(f"{self.output} is the input itself", "another output path")
        if pinhole is not None:
            trajectory = replace(trajectory, intrinsics=pinhole, cameras=None)
        if self.images is not None:
            trajectory = replace(trajectory, names=_image_names(self.images, len(trajectory)))
        lost = [
            part
            for part in ("names", "timestamps", "intrinsics", "cameras")
            if getattr(trajectory, part) is not None and part not in target.keeps
        ]
        write_trajectory(self.output, trajectory, self.to, self.overwrite)
        if lost:
            _LOG.info("%s does not store %s: dropped", self.to, ", ".join(lost))
        if "cameras" in target.keeps and trajectory.intrinsics is None and trajectory.cameras is None:
            _LOG.warning("%s has no camera, which its readers need; --intrinsics and --size give it one", self.output)
        if "names" in target.keeps and trajectory.names is None:
            _LOG.info("the input has no image names: using 0000.png, 0001.png, ...; --images takes the real names")
        if "timestamps" in target.keeps and trajectory.timestamps is None:
            _LOG.info("the input has no timestamps: frame numbers are written instead")
        print_summary(written=[self.output], as_json=self.json)


def _image_names(folder: Path, count: int) -> tuple[str, ...]:
    """Names of a folder's images in natural order, one per pose."""
    from coliags_plugin.core.scene_files import IMAGE_SUFFIXES, files_in
    from coliags_plugin.geometry.poses.trajectory import natural_order

    if not folder.is_dir():
        raise InputError(f"--images {folder}", "a folder of images")
    names = [path.name for path in files_in(folder, IMAGE_SUFFIXES)]
    if len(names) != count:
        raise InputError(
            f"{folder} holds {len(names)} images for {count} poses",
            "one image (.png, .jpg, .jpeg) for each pose",
            "Give the folder of exactly these frames",
        )
    return tuple(names[index] for index in natural_order(names))


@dataclass(frozen=True)
class PosesAlignCommand:
    """Align an estimated trajectory with a reference and compute its absolute and relative errors."""

    estimate: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="ESTIMATE")]
    """Estimated poses, in any format."""
    reference: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="REFERENCE")]
    """Reference poses, in any format."""
    scale: bool = False
    """Also estimate a scale (Sim(3) instead of SE(3)), for an estimate in another unit."""
    delta: int = 1
    """Matched frames between the two poses of a relative error."""
    match: Literal["auto", "name", "time", "index", "endogslam-train"] = "auto"
    """Criterion by which frames are matched; auto: by name, else by time, else by index."""
    tolerance: float = 0.02
    """Largest difference of matched timestamps, s."""
    unit: options.OptionalText = None
    """Name of the reference's unit of length; default: mm where its format is metric."""
    estimate_format: OptionalFormat = None
    """Format of the estimate; default: recognised from its content."""
    reference_format: OptionalFormat = None
    """Format of the reference; default: recognised from its content."""
    json: options.AsJson = False

    def run(self) -> None:
        """Align, and print a table of the errors."""
        from coliags_plugin.geometry.poses.alignment import align, associate

        _, estimate = read_and_log(self.estimate, self.estimate_format)
        kind, reference = read_and_log(self.reference, self.reference_format)
        unit = self.unit or kind.unit
        matches = associate(estimate, reference, self.match, self.tolerance)
        if matches.skipped:
            _LOG.warning("matched by %s, as names or times do not match (%s)", matches.by, "; ".join(matches.skipped))
        result = align(estimate, reference, matches, self.scale, self.delta)
        text = (
            f"{len(matches)} frames matched by {matches.by}, of {len(estimate)} estimated and {len(reference)} "
            f"reference ones\n{_described(result, unit)}\n{_table(result, unit)}"
        )
        if result.ate_share is not None:
            text += f"\nATE rmse: {100.0 * result.ate_share:.3g} % of the path, {result.path_length:.4g} {unit}"
        print_summary(text, result.to_json(unit), as_json=self.json)


def _described(result: Alignment, unit: str) -> str:
    from coliags_plugin.geometry.poses.trajectory import rotation_angles_deg

    angle = float(rotation_angles_deg(result.transform.rotation[None])[0])
    x, y, z = result.transform.translation
    scale = f", scale {result.transform.scale:.6g}" if result.with_scale else ""
    return (
        f"{'Sim(3)' if result.with_scale else 'SE(3)'}: rotation {angle:.3f} deg, "
        f"translation ({x:.4g}, {y:.4g}, {z:.4g}) {unit}{scale}"
    )


def _table(result: Alignment, unit: str) -> str:
    from coliags_plugin.reporting.model import simple_table
    from coliags_plugin.reporting.text_formats import terminal_text

    step = f"{result.delta} frame{'s' if result.delta > 1 else ''}"
    rows = [
        [name, kind, *vars(spread).values()]
        for name, kind, spread in (
            ("ATE", unit, result.ate),
            (f"RPE over {step}", unit, result.rpe_translation),
            (f"RPE over {step}", "deg", result.rpe_rotation_deg),
        )
    ]
    return terminal_text([simple_table(["error", "unit", "rmse", "mean", "median", "max"], rows)])


@dataclass(frozen=True)
class PosesExportCommand:
    """Export the sub-maps of a video: COLMAP and nerfstudio layouts, trajectories, and how they are joined."""

    reconstruction: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="OUT")]
    """Folder that `coliags reconstruct` made of a video."""
    output: options.Output
    """Folder to create."""
    link: bool = False
    """Do not copy images and depth, but give the files in OUT a second name, on the same disk: they take no space, and
    who changes one changes both."""
    overwrite: options.Overwrite = False
    json: options.AsJson = False

    def run(self) -> None:
        """Export, and print the sub-maps."""
        from coliags_plugin.pipeline.contents import MANIFEST, export_atlas

        manifest = export_atlas(self.reconstruction, self.output, self.overwrite, self.link)
        lines = [
            f"{submap['name']}: {len(submap['frames'])} frames, unit {submap['unit']}"
            + ("" if submap["nerfstudio"] else ", no dense depth")
            + (f", joined to {submap['joined_to']}" if submap["joined_to"] != submap["name"] else "")
            for submap in manifest["submaps"]
        ]
        print_summary("\n".join(lines), manifest, written=[self.output / MANIFEST], as_json=self.json)


Subcommand = (
    Annotated[PosesConvertCommand, tyro.conf.subcommand("convert")]
    | Annotated[PosesAlignCommand, tyro.conf.subcommand("align")]
    | Annotated[PosesSfmCommand, tyro.conf.subcommand("sfm")]
    | Annotated[PosesExportCommand, tyro.conf.subcommand("export")]
)


@dataclass(frozen=True)
class PosesCommand:
    """Convert, compare and export camera poses, or estimate them from images."""

    subcommand: tyro.conf.OmitArgPrefixes[tyro.conf.OmitSubcommandPrefixes[Subcommand]]
    """Subcommand."""

    def run(self) -> None:
        """Execute the subcommand."""
        self.subcommand.run()
