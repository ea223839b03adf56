"""Decoding of image files of unknown origin, and encoding of images as PNG, JPEG and TIFF."""

from __future__ import annotations

import io
import logging
import warnings
from collections.abc import Iterable, Sequence
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Bool, Shaped, UInt8

from coliags_plugin.core import bounds
from coliags_plugin.core.errors import InputError
from coliags_plugin.core.files import atomic_write
from coliags_plugin.core.libraries import decoder_messages
from coliags_plugin.core.text_files import unreadable

if TYPE_CHECKING:
    import PIL.Image

log = logging.getLogger(__name__)

_PNG = b"\x89PNG\r\n\x1a\n"
#: Bytes of a chunk of a PNG besides its data: length, type and checksum.
_CHUNK = 12


def decode_image(path: Path, flags: int | None = None) -> Shaped[np.ndarray, "H W *C"]:
    """Pixels of an image file in OpenCV's order of channels, decoded with its ``flags`` or unchanged.

    What would fill the memory is refused before anything is decoded.
    """
    import cv2

    try:
        data = path.read_bytes()
    except OSError as error:
        raise InputError(f"cannot read {path}: {error.strerror or error}", "a readable image") from error
    _check_size(path, data)
    image = None
    with decoder_messages():
        if data and (not data.startswith(_PNG[:4]) or _is_whole_png(data)):
            with suppress(cv2.error):  # of more than 2^30 pixels, for instance
                image = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED if flags is None else flags)
        if image is None:
            heif = data[4:8] == b"ftyp" and "It is HEIF (.heic, .avif): convert it to PNG"
            raise unreadable(
                path,
                f"{path} ({len(data)} bytes) cannot be decoded",
                "a complete image",
                heif or "It is damaged or cut short: fetch it again",
            )
    return np.asarray(image)


def read_rgb(path: Path) -> UInt8[np.ndarray, "H W 3"]:
    """Read an 8-bit colour image, without its alpha channel."""
    image = decode_image(path)
    if image.dtype != np.uint8 or image.ndim != 3 or image.shape[2] not in (3, 4):
        raise InputError(f"{path} is {kind_of(image)}", "an 8-bit RGB image", "Convert it")
    return np.ascontiguousarray(image[..., 2::-1])


def read_8_bit(path: Path) -> UInt8[np.ndarray, "H W C"]:
    """Read an image as 8-bit RGB or RGBA: grey is repeated, 16 bits are scaled by their full range."""
    import cv2

    image = decode_image(path)
    if image.dtype == np.uint16:
        image = (image >> 8).astype(np.uint8)
    codes = {1: cv2.COLOR_GRAY2RGB, 3: cv2.COLOR_BGR2RGB, 4: cv2.COLOR_BGRA2RGBA}
    code = codes.get(1 if image.ndim == 2 else image.shape[2])
    if image.dtype != np.uint8 or code is None:
        raise InputError(f"{path} is {kind_of(image)}", "an image of 8 or 16 bits, grey or RGB", "Convert it")
    return np.asarray(cv2.cvtColor(image, code))


def has_alpha(path: Path) -> bool:
    """Return True if an image file has an alpha channel or a transparent colour, by its header alone."""
    import PIL.Image

    with suppress(Exception), warnings.catch_warnings():  # the decoder says what is wrong with a damaged file
        warnings.simplefilter("ignore")
        with PIL.Image.open(path) as header:
            return bool(header.has_transparency_data)
    return False


def tell_of_alpha(where: Path, images: Sequence[bool]) -> None:
    """Log how many images have an alpha channel, by :func:`has_alpha` of each, and what becomes of it."""
    if any(images):
        text = "%s: %d of %d images have an alpha channel: pixels of alpha below 128 are masked, if it shows any at all"
        log.info(text, where, sum(images), len(images))


def read_alpha(path: Path) -> Bool[np.ndarray, "H W"] | None:
    """The mask in the alpha channel of an image, see :func:`has_alpha`: False below 128 of 255.

    None where no pixel is, or all are, as of a fourth byte that is not used.
    """
    image = decode_image(path)
    if image.ndim != 3 or image.shape[2] != 4 or image.dtype not in (np.uint8, np.uint16):
        return None
    shown = np.asarray(image[..., 3] > np.iinfo(image.dtype).max // 2)
    return None if shown.all() or not shown.any() else shown


def kind_of(image: np.ndarray) -> str:
    """Words for the channels and the type of decoded pixels, for errors."""
    channels = 1 if image.ndim == 2 else image.shape[2]
    return f"an image of {channels} channel{'s' * (channels > 1)} of {image.dtype}"


def sizes_text(sizes: Iterable[tuple[int, int]]) -> str:
    """Widths and heights as text: ``338 x 222``, or the smallest and largest of several, ``338 x 222 to 338 x 224``."""
    found = sorted(set(sizes))
    return " to ".join(f"{width} x {height}" for width, height in dict.fromkeys((found[0], found[-1])))


def _check_size(path: Path, data: bytes) -> None:
    """Raise InputError if the header states more images than one, or pixels than :mod:`coliags_plugin.core.bounds`."""
    import PIL.Image

    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # the decoder says what is wrong with a damaged file
            with PIL.Image.open(io.BytesIO(data)) as header:
                width, height = header.size
                count = _images_in(header)
    except PIL.Image.DecompressionBombError as error:
        raise InputError(f"{path}: {error}", f"an image of at most {bounds.IMAGE_PIXELS:,} pixels") from error
    except Exception:  # of a kind that Pillow does not know, or damaged: the decoder sees that
        return
    if width * height > bounds.IMAGE_PIXELS or max(width, height) > bounds.IMAGE_SIDE:
        raise InputError(
            f"{path} says that it has {width} x {height} pixels",
            f"at most {bounds.IMAGE_PIXELS:,} pixels, and {bounds.IMAGE_SIDE} a side",
            "It is damaged, or not a frame of a video",
        )
    if count > 1:
        raise InputError(f"{path} holds {count} images", "one image in a file", "Write each to a file of its own")


def _images_in(file: PIL.Image.Image) -> int:
    """Number of images in an open file, as in TIFF; without previews, which are smaller or in a camera's MPO."""
    size, count = file.size, getattr(file, "n_frames", 1)
    if count > 1 and file.format != "MPO":
        with suppress(Exception):  # damaged
            file.seek(1)
            return count if file.size == size else 1
    return 1


def _is_whole_png(data: bytes) -> bool:
    """True if all chunks of a PNG, up to IEND, lie within the file.

    OpenCV accepts truncated files, and allocates whatever length a chunk states.
    """
    position = len(_PNG)
    while position + _CHUNK <= len(data):
        length, kind = int.from_bytes(data[position : position + 4], "big"), data[position + 4 : position + 8]
        position += _CHUNK + length
        if kind == b"IEND":
            return position <= len(data)
    return False


def encode_image(pixels: np.ndarray, suffix: str = ".png", options: Sequence[int] = ()) -> bytes:
    """Encode RGB, RGBA or one channel as the bytes of a file, with OpenCV's options: keys and values in turn."""
    import cv2

    kind = f"{pixels.dtype} {list(pixels.shape)}"
    bgr = pixels[..., [2, 1, 0, 3] if pixels.shape[2] == 4 else slice(None, None, -1)] if pixels.ndim == 3 else pixels
    try:
        encoded, data = cv2.imencode(suffix, np.ascontiguousarray(bgr), list(options))
    except cv2.error as error:
        raise InputError(f"a {kind} image cannot be written as {suffix}: {error}") from error
    if not encoded:
        raise InputError(f"a {kind} image cannot be written as {suffix}")
    return bytes(data)


def write_image(path: Path, pixels: np.ndarray) -> None:
    """Write RGB, RGBA or one channel atomically in the format of the file's suffix; its folder is made."""
    atomic_write(path, encode_image(pixels, path.suffix))


def write_mask(path: Path, mask: np.ndarray) -> None:
    """Write a mask as one channel of 8 bits: 255 where it is True, 0 elsewhere."""
    write_image(path, mask.astype(np.uint8) * 255)


#: Brightness (of 255) from which a pixel is a highlight, and how many times as bright as its surroundings one is.
HIGHLIGHT_LEVEL, HIGHLIGHT_RATIO = 250, 1.5


def highlights(
    image: UInt8[np.ndarray, "H W 3"], level: int = HIGHLIGHT_LEVEL, ratio: float = HIGHLIGHT_RATIO
) -> Bool[np.ndarray, "H W"]:
    """Mask of specular highlights: pixels that are saturated or much brighter than their surroundings. [H, W]

    Nothing is a highlight where ``level`` is above 255.
    """
    import cv2

    brightest = image.max(axis=2)
    if level > 255:
        return np.zeros(brightest.shape, bool)
    # The window is wide enough that a highlight never fills half of it.
    surroundings = cv2.medianBlur(brightest, 2 * (max(image.shape[:2]) // 25) + 1).astype(np.float32)
    is_outlier = brightest > np.maximum(surroundings * ratio, surroundings + 20.0)
    return np.asarray((brightest >= level) | is_outlier)
