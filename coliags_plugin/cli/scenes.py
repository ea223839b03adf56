"""Commands on scenes: ``coliags phantom``, ``data check``, ``depth estimate``."""

from __future__ import annotations

import logging
import sys
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Annotated, Any, Literal

import tyro

from coliags_plugin.cli.texts import ESTIMATED_DEPTH_METHOD, parse_size, print_summary, train_command
from coliags_plugin.config import options


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
    light_offset: options.OptionalText = None
    """Lamp position X,Y,Z in camera axes, mm; default: the preset's."""
    polyps: int | None = None
    """Sessile polyps, 3 to 10 mm wide; 4 by default."""
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
        from coliags_plugin.config.assignments import parse_assignments

        names = ("preset", "trajectory", "frames", "light", "gain", "polyps", "rotation_views")
        values = {name: getattr(self, name) for name in names}
        options: dict[str, Any] = {"seed": self.seed, "layout": self.layout, "overwrite": self.overwrite}
        options |= {name: value for name, value in values.items() if value is not None}
        if self.size is not None:
            options["width"], options["height"] = parse_size(self.size)
        if self.light_offset is not None:
            options |= parse_assignments([f"light_offset=[{self.light_offset}]"])
        options |= parse_assignments(self.set)
        folder = make_phantom(self.output, **options)
        print_summary(facts={"settings": options}, written=[folder], then=[train_command(folder)], as_json=self.json)


@dataclass(frozen=True)
class DataCommand:
    """Describe a scene and check that images, poses, depth and calibration agree; exit status 1 if suspect."""

    action: tyro.conf.Positional[Literal["check"]]
    """Action."""
    scene: tyro.conf.Positional[options.SceneFolder]
    html: options.OptionalPath = None
    """Also write an HTML page with images and the trajectory."""
    set: options.Assignments = ()
    """An option of the data manager, for instance split=block."""
    data_format: options.DataFormat = None
    json: options.AsJson = False

    def run(self) -> None:
        """Run the checks and print the results."""
        from coliags_plugin.checks.data.check import check_scene
        from coliags_plugin.checks.data.page import check_page, verdict
        from coliags_plugin.engine.data_formats import open_scene
        from coliags_plugin.engine.progress import progress_callback
        from coliags_plugin.reporting.html_page import write_html
        from coliags_plugin.reporting.text_formats import page_text

        with progress_callback() as progress:
            scene = open_scene(self.scene, self.data_format, self.set, progress)
            at_stored_size = partial(open_scene, self.scene, scene.provenance.dataset, self.set, stored_size=True)
            check = check_scene(scene, progress, at_stored_size if scene.is_resized else None)
        page = check_page(check)
        if self.html is not None:
            write_html(page, self.html)
        chosen = [f"datamanager.{key.removeprefix('datamanager.')}" for key in self.set]
        chosen += [] if self.data_format is None else [f"datamanager.name={self.data_format}"]
        is_ready = check.facts["depth"] is not None and not check.findings
        print_summary(
            f"{page_text(page)}\n\n{verdict(check)}",
            check.as_json(),
            written=[] if self.html is None else [self.html],
            then=[train_command(self.scene, assignments=chosen)] if is_ready else [],
            as_json=self.json,
        )
        if check.findings:
            sys.exit(1)


_OptionalLength = Annotated[float | None, tyro.conf.arg(metavar="LENGTH")]


@dataclass(frozen=True)
class DepthCommand:
    """Estimate the dense depth of a video with known poses, with its confidence; write it as a scene to train on."""

    action: tyro.conf.Positional[Literal["estimate"]]
    """Action."""
    scene: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="SCENE")]
    """The scene's folder. Depth that it has is ignored."""
    output: options.Output
    """Folder to create, in nerfstudio's layout."""
    prior: options.OptionalPath = None
    """Folder of depth maps by image name (16-bit .png, .tiff, .npy or .exr), any unit, to fit instead of brightness."""
    near: _OptionalLength = None
    """Nearest depth, in the scene's unit of length, with --far; default: found from features."""
    far: _OptionalLength = None
    """Farthest depth."""
    jobs: options.OptionalInt = None
    """Number of threads; default: one for each core."""
    set: options.Assignments = ()
    """An option of the data manager, as width=675, or of estimation, as depth.agreement=0.01 (docs/depth.md)."""
    data_format: options.DataFormat = None
    overwrite: options.Overwrite = False
    json: options.AsJson = False

    def run(self) -> None:
        """Estimate, or resume; write the scene and print a summary."""
        from coliags_plugin.config.assignments import settings_of
        from coliags_plugin.core.errors import InputError
        from coliags_plugin.core.files import refuse_existing, refuse_overlap
        from coliags_plugin.engine.data_formats import open_scene
        from coliags_plugin.engine.progress import progress_callback
        from coliags_plugin.reconstruction.depth.scene import estimate_scene, training_options
        from coliags_plugin.reconstruction.depth.sweeping import DepthEstimationSettings

        refuse_overlap(self.output, self.scene)
        refuse_existing(self.output, self.overwrite)
        if (self.near is None) != (self.far is None):
            raise InputError("--near without --far, or the reverse", "both or neither")
        if self.jobs is not None and self.jobs < 1:
            raise InputError(f"--jobs {self.jobs}", "a number of threads of 1 or more")
        depth_settings = [item.removeprefix("depth.") for item in self.set if item.startswith("depth.")]
        settings = settings_of(DepthEstimationSettings, depth_settings, "depth.")
        with progress_callback() as progress:
            # Images are read when they are needed, so that memory does not grow with the video.
            of_manager = [item for item in self.set if not item.startswith("depth.")]
            reading = ["initial_points=none", "keep_pixels=false", *of_manager]
            scene = open_scene(self.scene, self.data_format, reading, progress)
            near_far = None if self.near is None or self.far is None else (self.near, self.far)
            estimated = estimate_scene(
                scene, self.output, settings, near_far, self.prior, self.jobs, self.overwrite, progress
            )
        for warning in estimated.warnings:
            logging.getLogger(__name__).warning(warning)
        train = train_command(self.output, ESTIMATED_DEPTH_METHOD, training_options(scene))
        print_summary(estimated.summary, written=[self.output], then=[train], as_json=self.json)
