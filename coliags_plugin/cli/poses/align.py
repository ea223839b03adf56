"""``coliags poses align``: trajectory errors of an estimate against a reference (ATE, RPE)."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import tyro

from coliags_plugin.cli import arguments
from coliags_plugin.cli.poses.arguments import OptionalFormat, read_and_log
from coliags_plugin.cli.summaries import print_summary

if TYPE_CHECKING:
    from coliags_plugin.geometry.poses.alignment import Alignment


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
    """How frames are matched; auto: by name, else by time, else by index."""
    tolerance: float = 0.02
    """Largest difference of matched timestamps, s."""
    unit: arguments.OptionalText = None
    """Name of the reference's unit of length; default: mm where its format is metric."""
    plot: arguments.OptionalPath = None
    """PNG to write: both trajectories from above and from the side, and the errors over frames."""
    estimate_format: OptionalFormat = None
    """Format of the estimate; default: recognised from its content."""
    reference_format: OptionalFormat = None
    """Format of the reference; default: recognised from its content."""
    overwrite: arguments.Overwrite = False
    json: arguments.AsJson = False

    def run(self) -> None:
        """Align, and print a table of the errors."""
        import logging

        from coliags_plugin.core.errors import InputError
        from coliags_plugin.geometry.poses.alignment import align
        from coliags_plugin.geometry.poses.association import associate

        log = logging.getLogger(__name__)
        if self.plot is not None and self.plot.suffix.lower() != ".png":
            raise InputError(f"--plot {self.plot}", "a file name that ends in .png")
        if self.plot is not None and self.plot.exists() and not self.overwrite:
            raise InputError(f"{self.plot} already exists", "a new file", "Choose another, or pass --overwrite")
        if self.plot is not None and (self.plot.is_dir() or self.plot in (self.estimate, self.reference)):
            raise InputError(f"{self.plot} is a folder or one of the inputs", "another file")
        _, estimate = read_and_log(self.estimate, self.estimate_format)
        kind, reference = read_and_log(self.reference, self.reference_format)
        unit = self.unit or kind.unit
        matches = associate(estimate, reference, self.match, self.tolerance)
        if matches.skipped:
            log.warning("matched by %s, as names or times do not match (%s)", matches.by, "; ".join(matches.skipped))
        result = align(estimate, reference, matches, self.scale, self.delta)
        text = (
            f"{len(matches)} frames matched by {matches.by}, of {len(estimate)} estimated and {len(reference)} "
            f"reference ones\n{_described(result, unit)}\n{_table(result, unit)}"
        )
        if result.ate_share is not None:
            text += f"\nATE rmse: {100.0 * result.ate_share:.3g} % of the path, {result.path_length:.4g} {unit}"
        worlds = result.world_rotation
        if worlds.reason:
            log.warning("%s: for the rotation error, the rotation is that by %s", worlds.reason, worlds.by)
        if self.plot is not None:
            from coliags_plugin.outputs.image_files import write_png
            from coliags_plugin.outputs.trajectory_plot import plot_trajectory

            write_png(self.plot, plot_trajectory(result, unit))
        written = [] if self.plot is None else [self.plot]
        print_summary(text, result.to_json(unit), written=written, as_json=self.json)


def _described(result: Alignment, unit: str) -> str:
    from coliags_plugin.geometry.poses.rigid import rotation_angles_deg

    angle = float(rotation_angles_deg(result.transform.rotation[None])[0])
    x, y, z = result.transform.translation
    scale = f", scale {result.transform.scale:.6g}" if result.with_scale else ""
    return (
        f"{'Sim(3)' if result.with_scale else 'SE(3)'}: rotation {angle:.3f} deg, "
        f"translation ({x:.4g}, {y:.4g}, {z:.4g}) {unit}{scale}"
    )


def _table(result: Alignment, unit: str) -> str:
    from coliags_plugin.reporting.model import simple_table
    from coliags_plugin.reporting.terminal import terminal_text

    step = f"{result.delta} frame{'s' if result.delta > 1 else ''}"
    rows = [
        [name, kind, *vars(spread).values()]
        for name, kind, spread in (
            ("ATE", unit, result.ate),
            ("rotation", "deg", result.rotation_deg),
            (f"RPE over {step}", unit, result.rpe_translation),
            (f"RPE over {step}", "deg", result.rpe_rotation_deg),
        )
    ]
    return terminal_text([simple_table(["error", "unit", "rmse", "mean", "median", "max"], rows)])
