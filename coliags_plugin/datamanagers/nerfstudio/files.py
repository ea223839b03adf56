"""What ``transforms.json`` says besides poses: files, cameras, a split (docs/layouts/nerfstudio.md)."""

from __future__ import annotations

import json
import posixpath
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any, cast

import numpy as np

from coliags_plugin.core.errors import InputError, did_you_mean
from coliags_plugin.datamanagers.nerfstudio.cameras import PinholeCamera, PixelCenters, camera_of, number
from coliags_plugin.datamanagers.reading.image_names import first_few
from coliags_plugin.datamanagers.reading.images import size_of
from coliags_plugin.lenses.models import Lens

FILE = "transforms.json"
_IMAGE_SUFFIXES = (".png", ".jpg", ".jpeg", ".JPG", ".JPEG", ".PNG")


@dataclass(frozen=True)
class Entry:
    """One of ``frames``: its files, which are there, and its camera."""

    name: str
    image: Path
    camera: Lens | PinholeCamera
    depth: Path | None
    mask: Path | None


class Transforms:
    """A ``transforms.json``.

    Args:
        path: The file; its poses have been read, so it is a JSON object with frames that have names.

    Raises:
        InputError: It cannot be read any more.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        try:
            self.content: dict[str, Any] = json.loads(path.read_text(encoding="utf-8-sig"))
        except (OSError, UnicodeDecodeError, json.JSONDecodeError) as error:
            raise InputError(f"cannot read {path}: {error}", "a transforms.json") from error
        self.frames: dict[str, dict[str, Any]] = {frame["file_path"]: frame for frame in self.content["frames"]}

    def entries(self, names: Sequence[str], pixel_centers: PixelCenters) -> list[Entry]:
        """The frames of these names.

        Raises:
            InputError: Files are missing, some frames alone have depth, or a camera is of another kind or incomplete.
        """
        images = self._images(names)
        depths = [self._file(name, "depth_file_path") for name in names]
        if None in depths and any(depths):
            lone = names[depths.index(None)]
            raise InputError(
                f"{self.path}: {sum(map(bool, depths))} of {len(depths)} frames have a depth_file_path; {lone} has not",
                "depth for every frame, or for none",
                "Add the missing ones",
            )
        # Where the file does not say how large images are, all are held to the size of the first.
        first_size = cache(lambda: size_of(images[0]))
        return [
            Entry(
                name,
                image,
                camera_of(
                    {**self.content, **self.frames[name]}, f"{self.path}, frame {name}", pixel_centers, first_size
                ),
                depth,
                self._file(name, "mask_path"),
            )
            for name, image, depth in zip(names, images, depths, strict=True)
        ]

    def points_file(self) -> Path | None:
        """The point cloud that belongs to the scene.

        Raises:
            InputError: It is named and not there.
        """
        name = self.content.get("ply_file_path")
        if name is None:
            return None
        path = self.path.parent / str(name)
        if not path.is_file():
            raise InputError(f"{self.path}: no file {path}", "the point cloud of ply_file_path", "Restore or remove it")
        return path

    def undone(self, positions: np.ndarray) -> np.ndarray:
        """Points of the file's world in the world that poses are read into (:mod:`coliags_plugin.poses.nerfstudio`)."""
        applied = np.array(self.content.get("applied_transform", np.eye(4)), np.float64)[:3]
        back = positions / float(self.content.get("applied_scale", 1.0)) - applied[:, 3]
        return np.asarray(back @ applied[:, :3])

    def split(self, names: Sequence[str]) -> dict[str, list[int]] | None:
        """Indices of training and of test frames among ``names``; None where the file does not say.

        The file's test frames are those of ``test_filenames`` or, where there are none, of ``val_filenames``.

        Raises:
            InputError: A list names no frame of the file, or a training frame is tested on.
        """
        listed = {part: self.content.get(f"{part}_filenames") for part in ("train", "val", "test")}
        if not listed["train"]:
            return None
        index_of = {posixpath.normpath(name): index for index, name in enumerate(names)}
        test = "test" if listed["test"] else "val"
        chosen = {
            "train": self._indices("train_filenames", listed["train"], index_of),
            "test": self._indices(f"{test}_filenames", listed[test] or [], index_of),
        }
        if both := set(chosen["train"]) & set(chosen["test"]):
            name = names[min(both)]
            raise InputError(f"{self.path}: {name} is in train_filenames and {test}_filenames", "one of the two")
        return chosen

    def depth_unit(self) -> float | None:
        """Units of the world before applied_scale that 1 in a depth file stands for; None where the file is silent."""
        if "depth_unit_scale_factor" not in self.content:
            return None
        factor = number(self.content, "depth_unit_scale_factor", str(self.path))
        if factor <= 0.0:
            raise InputError(f"{self.path}: depth_unit_scale_factor is {factor:g}", "a number above 0")
        return factor

    def _indices(self, key: str, listed: Any, index_of: Mapping[str, int]) -> list[int]:
        if not isinstance(listed, list) or not all(isinstance(name, str) for name in listed):
            raise InputError(f"{self.path}: {key} is no list of names", "file_paths of frames")
        unknown = [name for name in listed if posixpath.normpath(name) not in index_of]
        if unknown:
            hint = did_you_mean(unknown[0], index_of)
            raise InputError(f"{self.path}: {key} names {unknown[0]}", "a file_path of a frame", hint)
        return sorted({index_of[posixpath.normpath(name)] for name in listed})

    def _images(self, names: Sequence[str]) -> list[Path]:
        folder = self.path.parent
        found: list[Path | None] = []
        for name in names:
            candidates = (folder / name, *(folder / f"{name}{suffix}" for suffix in _IMAGE_SUFFIXES))
            found.append(next((path for path in candidates if path.is_file()), None))
        missing = [name for name, path in zip(names, found, strict=True) if path is None]
        if missing:
            raise InputError(
                f"{self.path}: {len(missing)} of {len(names)} frames have no image in {folder}: {first_few(missing)}",
                f"files of these names, as they are or with {', '.join(_IMAGE_SUFFIXES[:3])}",
                "Restore them, or remove their frames",
            )
        return cast(list[Path], found)

    def _file(self, name: str, key: str) -> Path | None:
        value = self.frames[name].get(key)
        if value is None:
            return None
        path = self.path.parent / str(value)
        if not path.is_file():
            raise InputError(f"{self.path}, frame {name}: no file {path}", f"the file of {key}", "Restore it")
        return path
