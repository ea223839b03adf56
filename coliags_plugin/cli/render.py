"""``coliags render``: render images and a video of a run."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Literal

import tyro

from coliags_plugin.cli import arguments
from coliags_plugin.cli.summaries import print_summary, view_command


@dataclass(frozen=True)
class RenderCommand:
    """Render rgb, depth and error images of a run, and a video along its trajectory."""

    path: arguments.RunFolder
    output: arguments.OptionalOutput = None
    """Folder to create; default RUN/renders, with --light or --flatten RUN/relit."""
    frames: str = "test"
    """Which frames: train, all, or the name of a test set."""
    video: bool = True
    """Also write trajectory.mp4, rgb beside depth."""
    fps: float = 15.0
    """Frames per second of the video."""
    depth_kind: Literal["accumulated", "expected", "median"] = "expected"
    """Which depth: sum w z, the paper's; the same divided by alpha; or that of the Gaussian at which half of the light
    is absorbed. Pictures are hatched where alpha is below 0.5."""
    depth_tiff: bool = False
    """Also write depth as float32 TIFF, scene units: depth_tiff/."""
    light: Annotated[tuple[str, ...], tyro.conf.arg(metavar="KEY=VALUE"), tyro.conf.UseAppendAction] = ()
    """Render under another lamp, for methods that model it: offset=[X,Y,Z] from the camera in its axes (mm),
    turn=[A,B] about its x and y axes (degrees), power=P (exponent of the cosine to the lamp's axis), intensity=F
    (factor)."""
    flatten: bool = False
    """Render every wall point as at one distance and angle from the lamp, without gain: default folder RUN/relit."""
    light_map: bool = False
    """Also write the light that the method has learned, beside a phantom's: light.html and light.json."""
    channel: Annotated[tuple[str, ...], tyro.conf.arg(metavar="NAME"), tyro.conf.UseAppendAction] = ()
    """Also write a feature channel of the method's Gaussians, for instance albedo."""
    data: arguments.MovedData = None
    device: arguments.Device = "auto"
    overwrite: arguments.Overwrite = False
    json: arguments.AsJson = False

    def run(self) -> None:
        """Render, and print the output folder."""
        from coliags_plugin.api.runs import load_run
        from coliags_plugin.config.assignments import parse_assignments
        from coliags_plugin.core.errors import InputError

        lamp = parse_assignments(self.light, "--light", "KEY=VALUE, for instance power=10")
        if lamp and self.flatten:
            raise InputError("--light and --flatten together", "one of them")
        run = load_run(self.path, data=self.data, device=self.device)
        if lamp:
            run = run.relight(**lamp)
        if self.flatten:
            run = run.flatten()
        folder = run.write_renders(
            self.output,
            self.frames,
            video=self.video,
            fps=self.fps,
            channels=self.channel,
            depth_kind=self.depth_kind,
            depth_tiff=self.depth_tiff,
            light_map=self.light_map,
            overwrite=self.overwrite,
        )
        print_summary(written=[folder], then=[view_command(self.path, self.data)], as_json=self.json)
