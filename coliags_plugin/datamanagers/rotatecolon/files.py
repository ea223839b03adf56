"""Finding the files of a RotateColon scene and reading its JSON (docs/layouts/rotatecolon.md 1, 2)."""

from __future__ import annotations

import logging
import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float

from coliags_plugin.core.errors import InputError
from coliags_plugin.core.json_files import read_json, read_number
from coliags_plugin.datamanagers.reading.files import numbered
from coliags_plugin.geometry.poses.nerfstudio import read as read_transforms

log = logging.getLogger(__name__)

LAYOUT = "RotateColon's transforms.json, train_views/NNNN.png and perhaps depth_train/NNNN.exr"
TRAIN, TRAIN_VIEWS, TRAIN_DEPTH = "transforms.json", "train_views", "depth_train"
TEST = "transforms_test.json"
POINTS = "init_point_cloud.ply"


@dataclass(frozen=True)
class ViewFiles:
    """Images, in order of their numbers, depth files, if any, and poses of one JSON file.

    Poses are rigid, with OpenCV axes, in the data's units; ``angle`` is the horizontal field of view, radians;
    ``unposed`` the number of images without a pose.
    """

    transforms: Path
    images: tuple[Path, ...]
    depths: tuple[Path, ...] | None
    camera_to_world: Float[np.ndarray, "N 4 4"]
    angle: float
    unposed: int


def find_views(transforms: Path, images: Path, depth: Path | None) -> ViewFiles:
    """Find the images and depth files of the poses in a JSON file.

    There must be an image for every pose; others are counted. Either all frames have a depth file, or none.
    """
    trajectory = read_transforms(transforms)
    expected = "the horizontal field of view, radians, between 0 and pi"
    content = read_json(transforms, "a transforms.json")
    image_files = numbered(images, "", frozenset({".png"}))
    stated = _numbers(transforms, trajectory.names_or_numbers())
    order = sorted(range(len(stated)), key=stated.__getitem__)
    numbers = [stated[index] for index in order]
    for number in numbers:
        if number not in image_files:
            raise InputError(
                f"{transforms}: frame {number} has no image {images / f'{number:04d}.png'}",
                "an image for every frame",
                "Restore it, or remove the frame",
            )
    unposed = len(image_files) - len(numbers)
    if unposed:
        log.warning("%s: %d images of %s have no pose and are left out", transforms, unposed, images.name)
    return ViewFiles(
        transforms,
        tuple(image_files[number] for number in numbers),
        _depths(numbers, depth),
        trajectory.camera_to_world[order],
        read_number(content, "camera_angle_x", transforms, expected, above=0.0, below=math.pi),
        unposed,
    )


def _numbers(transforms: Path, names: Sequence[str]) -> list[int]:
    """Frame numbers from ``file_path``, with or without folder and suffix."""
    numbers: list[int] = []
    for name in names:
        stem = name.replace("\\", "/").rsplit("/", 1)[-1].removesuffix(".png")
        if not stem.isdecimal():
            raise InputError(f"{transforms}: file_path '{name}'", "the frame's number, for instance '12'")
        number = int(stem)
        if number in numbers:
            raise InputError(f"{transforms}: frame {number} is repeated", "one pose for each image")
        numbers.append(number)
    return numbers


def _depths(numbers: Sequence[int], folder: Path | None) -> tuple[Path, ...] | None:
    files = {} if folder is None else numbered(folder, "", frozenset({".exr"}))
    lacking = [number for number in numbers if number not in files]
    if folder is None or len(lacking) == len(numbers):
        return None
    if lacking:
        raise InputError(
            f"{folder} has {len(numbers) - len(lacking)} depth files for {len(numbers)} frames; frame {lacking[0]} has "
            "none",
            "a depth file for every image, or none at all",
            "Restore the missing files: incomplete archives are common",
        )
    return tuple(files[number] for number in numbers)
