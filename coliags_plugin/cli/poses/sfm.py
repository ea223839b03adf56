"""``coliags poses sfm``: structure from motion, poses and points from images alone."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from coliags_plugin.cli.arguments import Assignments, OptionalInt, OptionalPath, OptionalText


@dataclass(frozen=True)
class Sfm:
    """Estimate poses, intrinsics and surface points from a video's images alone; write them as a scene."""

    frames: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="FRAMES")]
    """Folder of images, ordered by the numbers in their names."""
    out: Path
    """Folder to create, in COLMAP's layout."""
    camera: OptionalText = None
    """COLMAP's camera model, for instance PINHOLE or OPENCV_FISHEYE; default SIMPLE_RADIAL."""
    params: Annotated[OptionalText, tyro.conf.arg(metavar="P1,P2,...")] = None
    """Its parameters in COLMAP's order, pixel centres at integers + 0.5, kept fixed; default: estimated."""
    mask: OptionalPath = None
    """Mask image, black where pixels are ignored, or a folder with one per image."""
    every: int = 1
    """Use every n-th image."""
    max_frames: OptionalInt = None
    """Use at most the first n images."""
    set: Assignments = ()
    """An option of matching or mapping, for instance overlap=12 or features.max_features=2000."""
    overwrite: bool = False
    """Replace the output folder where it exists."""

    def run(self) -> None:
        """Reconstruct, write the scene and print a summary."""
        from coliags_plugin.cli.poses.arguments import SPARSE_DEPTH, refuse_output, settings_of, train_command
        from coliags_plugin.core.errors import InputError
        from coliags_plugin.engine.progress import progress_callback
        from coliags_plugin.reconstruction.structure.image_files import list_images
        from coliags_plugin.reconstruction.structure.sfm import SfmSettings, masks_for, reconstruct, write_sfm_scene

        refuse_output(self.out, self.frames, self.overwrite)
        if self.every < 1 or (self.max_frames is not None and self.max_frames < 2):
            raise InputError(f"--every {self.every}, --max-frames {self.max_frames}", "1 or more, and 2 or more")
        given = [] if self.camera is None else [f"camera.model={self.camera}"]
        given += [] if self.params is None else [f"camera.params=[{self.params}]"]
        settings = settings_of(SfmSettings, [*given, *self.set])
        images = list_images(self.frames)[:: self.every][: self.max_frames]
        masks = None if self.mask is None else masks_for(self.mask, images)
        with progress_callback() as progress:
            found = reconstruct(images, settings, masks, progress)
        write_sfm_scene(self.out, found, masks, self.overwrite)
        print(
            f"{found.summary()}\n"
            f"the unit of length is arbitrary: the median depth of the points is {found.median_depth:.4g} units; if it "
            "is known in mm, divide that by this number and pass --set datamanager.scale=QUOTIENT\n"
            f"{self.out}\n{train_command(self.out, SPARSE_DEPTH)}"
        )
