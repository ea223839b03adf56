"""``coliags phantom``: generate a synthetic colon dataset."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Any, Literal

import tyro

from coliags_plugin.cli import arguments
from coliags_plugin.cli.summaries import print_summary, train_command


@dataclass(frozen=True)
class PhantomCommand:
    """Generate a synthetic, physically lit colon with exact ground truth, in the layout of a dataset."""

    output: arguments.Output
    """Folder to create."""
    seed: int = 0
    """Random seed of the whole phantom."""
    trajectory: Literal["pullback", "rotation", "inspection"] = "pullback"
    """Withdrawal along the lumen, mostly rotation in place, or a withdrawal that approaches spots of the wall."""
    frames: int = 120
    """Frames of the sequence; every 8th is a test frame."""
    size: arguments.OptionalText = None
    """Image size WxH, pixels; default: the layout's own, 338x270 for most."""
    light: Literal["c3vd", "strong"] = "c3vd"
    """Preset of light and motion: c3vd is the fair default, strong the stress case."""
    gain: Literal["auto", "fixed"] | None = None
    """Exposure; default: the preset's."""
    light_offset: arguments.OptionalText = None
    """Lamp position X,Y,Z in camera axes, mm; default: the preset's."""
    polyps: int = 4
    """Sessile polyps, 3 to 10 mm wide."""
    rotation_views: int = 12
    """Extra test views rotated by 15 to 30 degrees; none in layouts that cannot store them."""
    set: arguments.Assignments = ()
    """Any other phantom setting, for instance roughness=0.4 (docs/phantom.md 6 lists them)."""
    layout: Annotated[str, tyro.conf.arg(metavar="NAME")] = "c3vd"
    """Files and folders to write (`coliags list phantom_layouts`)."""
    overwrite: arguments.Overwrite = False
    json: arguments.AsJson = False

    def run(self) -> None:
        """Generate the dataset."""
        from coliags_plugin.api.scenes import make_phantom
        from coliags_plugin.config.assignments import parse_assignments

        options: dict[str, Any] = {
            "seed": self.seed,
            "layout": self.layout,
            "trajectory": self.trajectory,
            "frames": self.frames,
            "light": self.light,
            "gain": self.gain,
            "polyps": self.polyps,
            "rotation_views": self.rotation_views,
            "overwrite": self.overwrite,
        }
        if self.size is not None:
            options["width"], options["height"] = arguments.parse_size(self.size)
        if self.light_offset is not None:
            options["light_offset"] = arguments.parse_vector("--light-offset", self.light_offset)
        options |= parse_assignments(self.set, expected="KEY=VALUE")
        made = make_phantom(self.output, **options)
        print_summary(facts={"settings": options}, written=[made], then=[train_command(made)], as_json=self.json)
