"""Finding and reading image files without poses."""

from __future__ import annotations

import logging
from collections.abc import Mapping, Sequence
from functools import cache
from pathlib import Path

import numpy as np
from jaxtyping import Bool, UInt8

from coliags_plugin.core.errors import InputError
from coliags_plugin.core.images import has_alpha, read_8_bit, read_alpha
from coliags_plugin.core.scene_files import FRAME_SUFFIXES, MASK_SUFFIXES, files_in, inventory, sidecar_files
from coliags_plugin.datamanagers.file_formats import all_of, read_mask
from coliags_plugin.geometry.poses.trajectory import natural_order

log = logging.getLogger(__name__)

#: Suffixes of images of other programs, which are not read.
_UNREAD = (".avif", ".dng", ".exr", ".gif", ".heic", ".heif", ".jp2", ".jxl", ".ppm")

#: An RGB image, and where its pixels count.
Image = UInt8[np.ndarray, "H W 3"]
Mask = Bool[np.ndarray, "H W"]
#: False where a pixel is ignored: one for all images, or one per image; None where none is.
Masks = Mapping[Path, Mask] | Mask | None

_FFMPEG = "make images with ffmpeg -i VIDEO -vf fps=10 FOLDER/%05d.png"


def list_images(folder: Path) -> list[Path]:
    """Image files of a folder in natural order, 2 before 10; at least two."""
    if folder.is_file():
        raise InputError(f"{folder} is a file", "a folder of images", f"{_FFMPEG}, if it is a video")
    if not folder.is_dir():
        raise InputError(f"no folder {folder}", "a folder of images", "Check the path")
    images, unread = files_in(folder, FRAME_SUFFIXES), files_in(folder, _UNREAD)
    if len(images) < 2:
        raise InputError(
            f"{folder} holds {len(images)} images" + (f" that are read, and {inventory(folder)}" if unread else ""),
            f"at least two ({', '.join(sorted(FRAME_SUFFIXES))})",
            "Convert them" if unread else f"Give the folder of the frames; from a video, {_FFMPEG}",
        )
    if unread:
        _warn_of_unread(folder, len(unread), unread[0].name)
    return [images[index] for index in natural_order([path.name for path in images])]


@cache
def _warn_of_unread(folder: Path, count: int, example: str) -> None:
    log.warning("%s: %d images are not read, as %s: convert them", folder, count, example)


def read_image(path: Path) -> Image:
    """Read an image as 8-bit RGB, converting other formats."""
    return np.ascontiguousarray(read_8_bit(path)[..., :3])


#: Mean difference of neighbouring images, of 255, up to which one repeats the other: up to 0.3 where a video repeats
#: frames, as compression changes them a little; 0.6 or more between frames of a slow video.
_SAME = 0.4


def is_repeated(before: Image, after: Image) -> bool:
    """True if an image shows the same as the one before, as in videos converted to a higher frame rate."""
    import cv2

    return before.shape == after.shape and float(cv2.absdiff(before, after).mean()) <= _SAME


def masks_for(path: Path, images: Sequence[Path]) -> Masks:
    """Read one mask for all images from a file, or from a folder a mask ``NAME.png`` or ``NAME.jpg.png`` per image."""
    if path.is_file():
        mask = read_mask(path, colored=True)
        log.info("%s: %.0f %% of all images ignored", path, 100.0 * (1.0 - mask.mean()))
        return mask
    files = sidecar_files(path, [image.name for image in images], MASK_SUFFIXES)
    masks = {}
    for image, file in zip(images, files.values(), strict=True):
        if file is None:
            raise InputError(
                f"{path} has no mask for {image.name}",
                f"{image.name}.png or {image.stem}.png",
                "Give one mask for all images, or a folder with a mask for each",
            )
        masks[image] = read_mask(file, colored=True)
    log.info("%s: a mask for each of %d images", path, len(masks))
    return masks


def mask_of(image: Path, masks: Masks) -> Mask | None:
    """The mask of an image, with that of its alpha channel."""
    mask, shown = masks.get(image) if isinstance(masks, Mapping) else masks, None
    if has_alpha(image):
        shown = read_alpha(image)
    if mask is not None and shown is not None and mask.shape != shown.shape:
        return mask  # which is refused with the image
    return all_of(mask, shown)


def file_names(names: Sequence[str], suffix: str) -> list[str]:
    """File names that sort in frame order; prefixed by the index where the names do not."""
    plain = [name.replace("/", "-") for name in names]
    if natural_order(plain) != list(range(len(plain))) or len(set(plain)) < len(plain):
        plain = [f"{index:05d}_{name}" for index, name in enumerate(plain)]
    return [f"{name}{suffix}" for name in plain]
