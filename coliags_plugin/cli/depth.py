"""``coliags depth``: dense depth from posed images."""

from __future__ import annotations

import logging
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import tyro

from coliags_plugin.cli import arguments
from coliags_plugin.cli.summaries import ESTIMATED_DEPTH_METHOD, print_summary, train_command
from coliags_plugin.config import options

_OptionalLength = Annotated[float | None, tyro.conf.arg(metavar="LENGTH")]


@dataclass(frozen=True)
class DepthCommand:
    """Estimate the dense depth of a video with known poses, with its confidence; write it as a scene to train on."""

    action: tyro.conf.Positional[Literal["estimate"]]
    """What to do."""
    scene: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="SCENE")]
    """The scene's folder. Depth that it has is ignored."""
    output: options.Output
    """Folder to create, in nerfstudio's layout."""
    prior: options.OptionalPath = None
    """Folder of depth maps by image name (.png of 16 bits, .npy or .exr), in any unit, to fit instead of brightness."""
    near: _OptionalLength = None
    """Nearest depth, in the scene's unit of length, with --far; default: found from features."""
    far: _OptionalLength = None
    """Farthest depth."""
    jobs: options.OptionalInt = None
    """Number of threads; default: one for each core."""
    set: options.Assignments = ()
    """An option of the data manager, as width=675, or of estimation, as depth.agreement=0.01 (docs/depth.md)."""
    format: options.DataFormat = None
    overwrite: options.Overwrite = False
    json: options.AsJson = False

    def run(self) -> None:
        """Estimate, or resume; write the scene and print a summary."""
        from coliags_plugin.core.errors import InputError
        from coliags_plugin.engine.data_formats import open_scene
        from coliags_plugin.engine.progress import progress_callback
        from coliags_plugin.reconstruction.depth.scene import DepthRequest, estimate_scene, training_options
        from coliags_plugin.reconstruction.depth.views import DepthEstimationSettings

        arguments.refuse_output(self.output, self.scene, self.overwrite)
        if (self.near is None) != (self.far is None):
            raise InputError("--near without --far, or the reverse", "both or neither")
        if self.jobs is not None and self.jobs < 1:
            raise InputError(f"--jobs {self.jobs}", "a number of threads of 1 or more")
        settings, options = arguments.settings_among(DepthEstimationSettings, self.set, "depth.")
        with progress_callback() as progress:
            # Images are read when they are needed, so that memory does not grow with the video.
            reading = ["initial_points=none", "keep_pixels=false", *options]
            scene = open_scene(self.scene, self.format, reading, progress)
            near_far = None if self.near is None or self.far is None else (self.near, self.far)
            request = DepthRequest(settings, near_far, self.prior, self.jobs)
            estimated = estimate_scene(scene, self.output, request, self.overwrite, progress)
        for warning in estimated.warnings:
            logging.getLogger(__name__).warning(warning)
        train = train_command(self.output, ESTIMATED_DEPTH_METHOD, training_options(scene))
        print_summary(estimated.summary, written=[self.output], then=[train], as_json=self.json)
