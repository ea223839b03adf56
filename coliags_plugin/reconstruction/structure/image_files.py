"""Finding and reading image files without poses."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
from jaxtyping import Bool, UInt8

from coliags_plugin.core.errors import InputError
from coliags_plugin.core.images import decode_image
from coliags_plugin.geometry.poses.trajectory import natural_order

#: Suffixes of image files, in lower case.
IMAGE_SUFFIXES = (".png", ".jpg", ".jpeg", ".tif", ".tiff", ".bmp")

#: False where a pixel is ignored: one for all images, or one per image; None where none is.
Masks = Mapping[Path, Bool[np.ndarray, "H W"]] | Bool[np.ndarray, "H W"] | None

_FFMPEG = "make images with ffmpeg -i VIDEO -vf fps=10 FOLDER/%05d.png"


def list_images(folder: Path) -> list[Path]:
    """Image files of a folder in natural order, 2 before 10; at least two."""
    if folder.is_file():
        raise InputError(f"{folder} is a file", "a folder of images", f"{_FFMPEG}, if it is a video")
    if not folder.is_dir():
        raise InputError(f"no folder {folder}", "a folder of images", "Check the path")
    images = [path for path in folder.iterdir() if path.suffix.lower() in IMAGE_SUFFIXES and path.is_file()]
    if len(images) < 2:
        raise InputError(
            f"{folder} holds {len(images)} images",
            f"at least two ({', '.join(IMAGE_SUFFIXES)})",
            f"Give the folder of the frames; from a video, {_FFMPEG}",
        )
    return [images[index] for index in natural_order([path.name for path in images])]


def read_image(path: Path) -> UInt8[np.ndarray, "H W 3"]:
    """Read an image as 8-bit RGB, converting other formats."""
    import cv2

    # Ignore the EXIF orientation, as COLMAP's cameras do.
    image = decode_image(path, cv2.IMREAD_COLOR | cv2.IMREAD_IGNORE_ORIENTATION)
    return np.ascontiguousarray(image[..., ::-1])


#: Mean difference of neighbouring images, of 255, up to which one repeats the other: up to 0.3 where a video repeats
#: frames, as compression changes them a little; 0.6 or more between frames of a slow video.
_SAME = 0.4


def is_repeated(before: UInt8[np.ndarray, "H W 3"], after: UInt8[np.ndarray, "H W 3"]) -> bool:
    """Whether an image shows the same as the one before, as in videos converted to a higher frame rate."""
    import cv2

    return before.shape == after.shape and float(cv2.absdiff(before, after).mean()) <= _SAME


def read_mask(path: Path) -> Bool[np.ndarray, "H W"]:
    """Read a mask: True where the image is not black."""
    return np.asarray(read_image(path).max(axis=2) > 0)


def masks_for(path: Path, images: Sequence[Path]) -> Masks:
    """Read one mask for all images from a file, or from a folder a mask ``NAME.png`` or ``NAME.jpg.png`` per image."""
    if path.is_file():
        return read_mask(path)
    masks = {}
    for image in images:
        candidates = (path / f"{image.name}.png", path / f"{image.stem}.png")
        file = next((candidate for candidate in candidates if candidate.is_file()), None)
        if file is None:
            raise InputError(
                f"{path} has no mask for {image.name}",
                f"{candidates[0].name} or {candidates[1].name}",
                "Give one mask for all images, or a folder with a mask for each",
            )
        masks[image] = read_mask(file)
    return masks


def mask_of(image: Path, masks: Masks) -> Bool[np.ndarray, "H W"] | None:
    """The mask of an image."""
    return masks.get(image) if isinstance(masks, Mapping) else masks


def file_names(names: Sequence[str], suffix: str) -> list[str]:
    """File names that sort in frame order; prefixed by the index where the names do not."""
    plain = [name.replace("/", "-") for name in names]
    if natural_order(plain) != list(range(len(plain))) or len(set(plain)) < len(plain):
        plain = [f"{index:05d}_{name}" for index, name in enumerate(plain)]
    return [f"{name}{suffix}" for name in plain]
