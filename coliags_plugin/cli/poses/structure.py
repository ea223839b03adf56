"""``coliags poses sfm``: poses from images alone."""

from __future__ import annotations

import logging
import math
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro

from coliags_plugin.cli import arguments
from coliags_plugin.cli.summaries import depth_commands, print_summary
from coliags_plugin.config import options
from coliags_plugin.core.errors import InputError

if TYPE_CHECKING:
    from coliags_plugin.reconstruction.structure.sfm import Reconstruction

_LOG = logging.getLogger(__name__)


@dataclass(frozen=True)
class PosesSfmCommand:
    """Estimate poses, intrinsics and surface points from a video's images alone; write them as a scene."""

    frames: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="FRAMES")]
    """Video, folder of one with its calibration, or folder of images ordered by the numbers in their names."""
    output: options.Output
    """Folder to create, in COLMAP's layout."""
    camera: options.OptionalText = None
    """A known camera, scaled to the images (c3vd: whole frames of C3VD; c3vd-undistorted; NAME.xml: of a calibration
    file), or a camera model of COLMAP, for instance PINHOLE or OPENCV_FISHEYE; default: of the calibration file in the
    folder, else the better of SIMPLE_RADIAL_FISHEYE and SIMPLE_RADIAL."""
    params: Annotated[options.OptionalText, tyro.conf.arg(metavar="P1,P2,...")] = None
    """Parameters of COLMAP's model in its order, pixel centres at integers + 0.5, kept fixed; default: estimated."""
    diameter: options.OptionalFloat = None
    """The colon's typical inner diameter, which fixes the scale roughly; default: the scale stays unknown."""
    distance: Annotated[options.OptionalText, tyro.conf.arg(metavar="IMAGE,IMAGE,MM")] = None
    """Known distance between the cameras of two images, which fixes the scale."""
    mask: options.OptionalPath = None
    """Mask image, black where pixels are ignored, or a folder with one per image; default: black surroundings and
    overlays are found, of images of one size."""
    every: int = 1
    """Use every n-th image."""
    max_frames: options.OptionalInt = None
    """Use at most the first n images."""
    set: options.Assignments = ()
    """An option of matching or mapping, for instance exhaustive_up_to=80 or features.max_features=2000."""
    overwrite: options.Overwrite = False
    json: options.AsJson = False

    def run(self) -> None:
        """Reconstruct, write the scene and print a summary."""
        from coliags_plugin.config.assignments import settings_of
        from coliags_plugin.engine.progress import progress_callback
        from coliags_plugin.pipeline.frame_sources import image_files, opened_recording
        from coliags_plugin.pipeline.survey import FrameSurvey
        from coliags_plugin.reconstruction.structure.colmap_scene import write_sfm_scene
        from coliags_plugin.reconstruction.structure.image_files import Masks, masks_for, read_image
        from coliags_plugin.reconstruction.structure.sfm import millimetres, reconstruct, scaled
        from coliags_plugin.reconstruction.structure.sfm_settings import SfmSettings

        arguments.refuse_output(self.output, self.frames, self.overwrite)
        if self.every < 1 or (self.max_frames is not None and self.max_frames < 2):
            raise InputError(f"--every {self.every}, --max-frames {self.max_frames}", "1 or more, and 2 or more")
        known_distance = self._known_distance()
        given = [] if self.camera is None else [f"camera.model={self.camera}"]
        given += [] if self.params is None else [f"camera.params=[{self.params}]"]
        frames, settings = opened_recording(self.frames, settings_of(SfmSettings, [*given, *self.set]))
        survey = FrameSurvey(frames)
        with progress_callback() as progress, image_files(frames, progress, survey.add) as files:
            images = files[:: self.every][: self.max_frames]
            masks: Masks = None
            if self.mask is not None:
                masks = masks_for(self.mask, images)
            else:
                for path in images if frames.is_dir() else ():
                    survey.add(read_image(path))
                if (found := survey.mask()) is not None:
                    share = 100.0 * (1.0 - found.mean())
                    _LOG.info("ignored: black surroundings and overlays, %.0f %% of the image", share)
                    masks = found
            atlas = reconstruct(images, settings, masks, progress)
            factor = millimetres(atlas.largest, self.diameter, known_distance)
            if factor is not None:
                atlas = replace(atlas, models=(scaled(atlas.largest, factor), *atlas.models[1:]))
            write_sfm_scene(self.output, atlas, masks, self.overwrite, [] if factor is None else ["mm"])
        text = f"{atlas.summary()}\n{_unit(atlas.largest, factor)}"
        print_summary(text, written=[self.output], then=depth_commands(self.output), as_json=self.json)

    def _known_distance(self) -> tuple[str, str, float] | None:
        """The parts of ``--distance``."""
        if self.diameter is not None and self.distance is not None:
            raise InputError("--diameter and --distance", "one of them")
        if self.diameter is not None and not (math.isfinite(self.diameter) and self.diameter > 0.0):
            raise InputError(f"--diameter {self.diameter:g}", "a length in mm above 0")
        if self.distance is None:
            return None
        try:
            first, second, text = self.distance.split(",")
            length = float(text)
        except ValueError as error:
            raise InputError(f"--distance {self.distance}", "IMAGE,IMAGE,MM: two image names and a length") from error
        if not (math.isfinite(length) and length > 0.0):
            raise InputError(f"--distance {self.distance}", "a length in mm above 0")
        return first, second, length


def _unit(model: Reconstruction, factor: float | None) -> str:
    depth = f"the median depth of the points is {model.median_depth:.4g}"
    if factor is not None:
        return f"unit: mm, {factor:.4g} per unit of the model; {depth} mm"
    return f"unit: unknown, as images alone do not determine it; {depth} units (--diameter or --distance fix the scale)"
