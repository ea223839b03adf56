"""``coliags poses convert``: convert poses between file formats."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from coliags_plugin.cli import arguments
from coliags_plugin.cli.poses.arguments import OptionalFormat, parse_intrinsics, read_and_log
from coliags_plugin.cli.summaries import print_summary


@dataclass(frozen=True)
class PosesConvertCommand:
    """Write poses in another format (c3vd, tum, endogslam, colmap, colmap-text, nerfstudio)."""

    input: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="IN")]
    """File with poses, or the folder of a COLMAP model."""
    output: arguments.Output
    """File to write; for COLMAP, folder to create."""
    to: Annotated[str, tyro.conf.arg(metavar="FORMAT")]
    """Format to write."""
    intrinsics: Annotated[arguments.OptionalText, tyro.conf.arg(metavar="FX,FY,CX,CY")] = None
    """Pinhole intrinsics of all images, px, pixel centres at integers + 0.5; default: the input's."""
    size: Annotated[arguments.OptionalText, tyro.conf.arg(metavar="WxH")] = None
    """Image size, px; with --intrinsics."""
    images: arguments.OptionalPath = None
    """Folder whose images, in natural order, give the poses their names; default: the input's names."""
    from_format: Annotated[OptionalFormat, tyro.conf.arg(name="from")] = None
    """Format of the input; default: recognised from its content."""
    overwrite: arguments.Overwrite = False
    json: arguments.AsJson = False

    def run(self) -> None:
        """Convert the poses."""
        import logging
        from dataclasses import replace

        from coliags_plugin.core.errors import InputError
        from coliags_plugin.geometry.poses.formats import format_named, write_trajectory

        log = logging.getLogger(__name__)
        target = format_named(self.to)
        pinhole = parse_intrinsics(self.intrinsics, self.size)
        _, trajectory = read_and_log(self.input, self.from_format)
        if self.output.exists() and self.output.samefile(self.input):
            raise InputError(f"{self.output} is the input itself", "another output path")
        if pinhole is not None:
            trajectory = replace(trajectory, intrinsics=pinhole)
        if self.images is not None:
            trajectory = replace(trajectory, names=_image_names(self.images, len(trajectory)))
        lost = [
            part
            for part in ("names", "timestamps", "intrinsics")
            if getattr(trajectory, part) is not None and part not in target.keeps
        ]
        write_trajectory(self.output, trajectory, self.to, self.overwrite)
        if lost:
            log.info("%s does not store %s: dropped", self.to, ", ".join(lost))
        if "names" in target.keeps and trajectory.names is None:
            log.info("the input has no image names: using 0000.png, 0001.png, ...; --images takes the real names")
        if "timestamps" in target.keeps and trajectory.timestamps is None:
            log.info("the input has no timestamps: frame numbers are written instead")
        print_summary(written=[self.output], as_json=self.json)


def _image_names(folder: Path, count: int) -> tuple[str, ...]:
    """Names of a folder's images in natural order, one per pose."""
    from coliags_plugin.core.errors import InputError
    from coliags_plugin.geometry.poses.trajectory import natural_order

    if not folder.is_dir():
        raise InputError(f"--images {folder}", "a folder of images")
    names = [path.name for path in folder.iterdir() if path.suffix.lower() in (".png", ".jpg", ".jpeg")]
    if len(names) != count:
        raise InputError(
            f"{folder} holds {len(names)} images for {count} poses",
            "one image (.png, .jpg, .jpeg) for each pose",
            "Give the folder of exactly these frames",
        )
    return tuple(names[index] for index in natural_order(names))
