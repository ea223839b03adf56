"""Data manager for REIM-NeRF's preprocessed C3VD (Psychogyios et al., 2023): fisheye images and distance maps."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Float32, Shaped
from pydantic import Field
from typing_extensions import override

from coliags_plugin.core import scene_files as reading
from coliags_plugin.core.errors import InputError
from coliags_plugin.core.json_files import image_size, read_json, read_number
from coliags_plugin.core.splits import Split
from coliags_plugin.datamanagers.file_formats import DepthFormat, Transforms, read_gray, read_mask
from coliags_plugin.datamanagers.recorded import RecordedDataManager, Recording, SceneSettings
from coliags_plugin.datamanagers.shots import make_shots
from coliags_plugin.geometry.lenses.models import FisheyeLens, Lens
from coliags_plugin.geometry.poses.trajectory import natural_order

MASK_FILE = "rgb_mask.png"
#: Parts of a sequence; ``test`` is all frames, ``true_test`` those in neither training nor validation.
PARTS = ("train", "val", "test", "true_test")
EXPECTED = "images/, distmaps/, rgb_mask.png and transforms_train.json as REIM-NeRF's preprocessing writes them"
#: z-depth at which C3VD's depth is clipped, mm. The preprocessing treats clipped pixels as valid.
C3VD_RANGE = 100.0
#: Keys that have the same value in all files of a sequence.
_SHARED = (
    *("fx", "fy", "cx", "cy", "k1", "k2", "k3", "k4", "p1", "p2", "w", "h"),
    *("camera_model", "scene_scale", "distmap_scale", "scene_T"),
)
#: Digits tried of numbers in file names.
_DIGITS = 6
#: An image, its distance map if there is any, and its pose with OpenCV axes, mm. [4, 4]
_Frame = tuple[Path, Path | None, np.ndarray]


@dataclass(frozen=True, eq=False)
class RayDistance(DepthFormat):
    """16-bit distance along the ray; 0 is unknown, and C3VD's 100 mm z-depth is a lower bound."""

    size: float  # mm per step, along the ray
    cosine: Float32[np.ndarray, "h w"]  # ratio of z-depth to ray distance at each working pixel's source pixel

    @override
    def read(self, path: Path) -> Shaped[np.ndarray, "H W"]:
        return read_gray(path, 16, "a one-channel 16-bit distance map")

    @override
    def decode(
        self, stored: Shaped[np.ndarray, "h w"]
    ) -> tuple[Float32[np.ndarray, "h w"], Float32[np.ndarray, "h w"] | None]:
        depth = np.asarray(stored.astype(np.float32) * np.float32(self.size) * self.cosine)
        # In the distance map or in the original depth, with one step for rounding.
        clipped = (stored == 65535) | (depth >= C3VD_RANGE - self.size)
        bound = np.where(clipped, np.minimum(depth, np.float32(C3VD_RANGE)), np.float32(np.nan))
        depth[(stored == 0) | clipped] = np.nan
        return depth, bound if clipped.any() else None


class ReimNerfDataSettings(SceneSettings):
    """Options of the ``reim-nerf`` data manager."""

    split: Split = Field(
        "own",
        description="Test frames: 'own': trains on transforms_train.json and tests on transforms_true_test.json, as "
        "REIM-NeRF does; its validation frames are in neither. Others as for every data manager.",
    )
    mask: bool = Field(True, description=f"Ignore the pixels masked by {MASK_FILE}.")


class ReimNerfDataManager(RecordedDataManager):
    """Reads REIM-NeRF's preprocessed C3VD in millimetres and C3VD's world frame (docs/layouts/reim-nerf.md)."""

    Settings = ReimNerfDataSettings

    settings: ReimNerfDataSettings
    name = "reim-nerf"
    masks_at = MASK_FILE
    #: REIM-NeRF trains and evaluates at a fifth of the raw size.
    fits = (270, 216)
    seen_split = "own"

    @classmethod
    @override
    def recognise(cls, path: Path) -> str | None:
        if not (path / "transforms_train.json").is_file():
            return None
        beside = next((name for name in ("distmaps", MASK_FILE) if (path / name).exists()), None)
        return None if beside is None else f"transforms_train.json beside {beside}"

    @override
    def open(self, path: Path) -> Recording:
        settings = self.settings
        reading.require_folder(path, EXPECTED)
        files = {part: file for part in PARTS if (file := path / f"transforms_{part}.json").is_file()}
        if "train" not in files:
            raise InputError(f"{path} holds {reading.inventory(path)}", EXPECTED, "Add transforms_train.json")
        if settings.split == "own" and "true_test" not in files:
            raise InputError(
                f"{path} has no transforms_true_test.json",
                "the test frames of split 'own'",
                "Add it, or choose another split",
            )
        contents = {part: read_json(file, "a JSON object with frames") for part, file in files.items()}
        parts = {
            part: Transforms(file, settings.outside_files)
            for part, file in files.items()
            # A short video may have no validation frames, but there must be training frames.
            if part == "train" or not isinstance(contents[part], dict) or contents[part].get("frames") != []
        }
        file, first = files["train"], contents["train"]
        _refuse_different(files, contents)
        lens, (scale, shift) = _lens(file, first), _normalisation(file, first)
        distmap_scale = read_number(
            {"distmap_scale": math.pi, **first}, "distmap_scale", file, "a number above 0", above=0.0
        )
        frames: dict[str, _Frame] = {}
        for part, transforms in parts.items():
            for name, frame in _frames(transforms, scale, shift).items():
                other = frames.setdefault(name, frame)
                if other[1] != frame[1] or not np.allclose(other[2], frame[2], atol=1e-4):
                    raise InputError(
                        f"{files[part]}: pose or distance map of {name} differs from another file's",
                        "the same values for a frame in all files",
                        "Write all files in one run",
                    )
        unordered = [*frames]
        names = [unordered[index] for index in natural_order(unordered)]
        distances = reading.for_all({name: frames[name][1] for name in names}, path, "a distmap_path")
        indices = {
            part: [index for index, name in enumerate(names) if part in parts and name in parts[part].names]
            for part in files
        }
        mask = path / MASK_FILE if settings.mask else None
        shows = None if mask is None else _shows(mask, lens.width, lens.height)
        rectification = self.rectification_of(lens, file, shows)
        form = RayDistance(distmap_scale / 65535.0 / scale, rectification.nearest(ray_cosines(lens)))
        images, poses = [frames[name][0] for name in names], np.stack([frames[name][2] for name in names])
        shots = make_shots(images, rectification, poses, distances, form)
        reading.warn_of_unposed(path, reading.unposed_images(images, distances))
        facts: dict[str, Any] = {
            "layout": "REIM-NeRF",
            "lens": "fisheye of the JSON files",
            "parts": {part: len(frames) for part, frames in indices.items()},
            "pose_convention": {
                "order": "camera-to-world, OpenGL axes, normalised",
                "scene_scale": scale,
                "scene_shift_mm": [float(value) for value in shift],
            },
        }
        return Recording(
            folder=path,
            kind=f"REIM-NeRF layout, {'no mask' if mask is None else f'all masked by {MASK_FILE}'}",
            shots=shots,
            facts=facts,
            described_by=(*files.values(), mask),
            own_split={"train": indices["train"], "test": indices.get("true_test", ())},
        )


def _shows(mask: Path, width: int, height: int) -> Bool[np.ndarray, "H W"]:
    """Valid stored pixels: the mask file is white where a pixel is ignored."""
    do = "Restore it, or `datamanager.mask=false`"
    ignored = read_mask(reading.required_file(mask, "the mask of pixels outside the lens's image circle", do))
    if ignored.shape != (height, width):
        raise InputError(f"{mask} is {ignored.shape[1]} x {ignored.shape[0]}", f"the images' size, {width} x {height}")
    return np.asarray(~ignored)


def ray_cosines(lens: Lens) -> Float32[np.ndarray, "H W"]:
    """Ratio of z-depth to ray distance at every stored pixel; 0 outside the lens's field of view.

    The preprocessing takes its rays at integers + 0.5 with a calibration that counts from integers, half a pixel off
    the centres, and so does this inverse; the half pixel changes depth by at most 3e-4 of its value.
    """
    column, row = np.meshgrid(np.arange(lens.width) + 1.0, np.arange(lens.height) + 1.0)
    rays = lens.unproject(np.stack([column.ravel(), row.ravel()], axis=1))
    cosine = 1.0 / np.linalg.norm(rays, axis=1)
    return np.nan_to_num(cosine, nan=0.0).astype(np.float32).reshape(lens.height, lens.width)


def _refuse_different(files: Mapping[str, Path], contents: Mapping[str, Mapping[str, Any]]) -> None:
    """Refuse files whose camera or scale differs from that of the training frames."""
    first = contents["train"]
    for part, content in contents.items():
        key = next((key for key in _SHARED if content.get(key) != first.get(key)), None)
        if key is not None:
            raise InputError(
                f"{files[part]}: {key} differs from {files['train'].name}",
                "one camera and one scale for all files",
                "Write all files in one run",
            )


def _lens(file: Path, content: Mapping[str, Any]) -> FisheyeLens:
    if content.get("camera_model") not in ("FISHEYE_OPENCV", "OPENCV_FISHEYE"):
        raise InputError(f"{file}: camera_model {content.get('camera_model')!r}", "FISHEYE_OPENCV")
    width, height = image_size(content, file)
    fx, fy = (read_number(content, key, file, "a number above 0", above=0.0) for key in ("fx", "fy"))
    cx, cy, k1, k2, k3, k4 = (read_number(content, key, file) for key in ("cx", "cy", "k1", "k2", "k3", "k4"))
    for key in ("p1", "p2"):
        if content.get(key):
            raise InputError(f"{file}: {key} = {content[key]!r}", "0: OpenCV's fisheye has no such term")
    cx, cy = cx + 0.5, cy + 0.5  # the file counts pixel centres at integers
    return FisheyeLens(width=width, height=height, fx=fx, fy=fy, cx=cx, cy=cy, k1=k1, k2=k2, k3=k3, k4=k4)


def _normalisation(file: Path, content: Mapping[str, Any]) -> tuple[float, Float[np.ndarray, "3"]]:
    scale = read_number(content, "scene_scale", file, "a number above 0", above=0.0)
    try:
        shift = np.array(content.get("scene_T"), np.float64)
    except (TypeError, ValueError, OverflowError):
        shift = np.empty(0)
    is_matrix = shift.shape == (4, 4) and np.isfinite(shift).all()
    if not is_matrix or not np.allclose(shift[:, :3], np.eye(4)[:, :3]) or not np.isclose(shift[3, 3], 1.0):
        raise InputError(f"{file}: scene_T is not a translation", "a 4x4 matrix without rotation")
    return scale, shift[:3, 3]


def _frames(transforms: Transforms, scale: float, shift: Float[np.ndarray, "3"]) -> dict[str, _Frame]:
    """Frames of one file by the names of their images."""
    result: dict[str, _Frame] = {}
    poses = transforms.trajectory.camera_to_world
    for name, frame, pose in zip(transforms.names, transforms.frames, poses, strict=True):
        camera_to_world = pose.copy()
        camera_to_world[:3, 3] = pose[:3, 3] / scale - shift
        distances = frame.get("distmap_path")
        paths = []
        for text in [name, *([distances] if isinstance(distances, str) else [])]:
            named = transforms.named(text)
            paths.append(_padded_otherwise(named))
            if not paths[-1].is_file():
                raise InputError(
                    f"{transforms.path} names {named}, which does not exist, nor with its number padded otherwise",
                    "every named file",
                    "Restore it",
                )
        result[name] = (paths[0], paths[1] if len(paths) > 1 else None, camera_to_world)
    return result


def _padded_otherwise(named: Path) -> Path:
    """The file that a JSON file names, or else the one whose number has more or fewer leading zeros.

    C3VD's releases and the preprocessing write both 0_color.png and 0000_color.png.
    """
    number = re.match(r"\d+", named.name)
    if named.is_file() or number is None:
        return named
    rest = named.name[number.end() :]
    others = (named.with_name(f"{int(number.group()):0{digits}d}{rest}") for digits in range(1, _DIGITS + 1))
    return next((path for path in others if path.is_file()), named)
