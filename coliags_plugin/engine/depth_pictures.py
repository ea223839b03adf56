"""Pictures of the expected depth of evaluated views, on one scale."""

from __future__ import annotations

from pathlib import Path

from coliags_plugin.outputs.colormaps import color_bar, colorize_depth, common_limits
from coliags_plugin.outputs.image_files import read_depth_tiff, write_png

#: Folders within an evaluation: depth maps, NaN where pixels are nearly transparent, and their pictures.
EXPECTED_DEPTH, PICTURES = "expected_depth", "depth_pictures"
_SCALE = "scale.png"


def write_depth_pictures(evaluation: Path, unit: str) -> None:
    """Colour the depth maps of ``expected_depth/SET/`` as ``depth_pictures/SET/``, beside their scale.

    Nearly transparent pixels are hatched. The unit is that of the depth.
    """
    files = sorted((evaluation / EXPECTED_DEPTH).glob("*/*.tiff"))
    if not files:
        return
    limits = common_limits(read_depth_tiff(file) for file in files)
    for file in files:
        picture = evaluation / PICTURES / file.parent.name / f"{file.stem}.png"
        write_png(picture, colorize_depth(read_depth_tiff(file), limits, hatched=True))
    write_png(evaluation / PICTURES / _SCALE, color_bar(limits, unit, "depth"))
