"""Every layout that is read, and forms of it: where its files are, and ways to damage them."""

from __future__ import annotations

import json
import re
import shutil
import struct
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import OpenEXR
import pycolmap

from tests.datamanagers.wall_scenes import FRAMES, write_wall
from tests.layouts.rotatecolon import write_exr

Spoil = Callable[[Path], Any]


@dataclass(frozen=True)
class Kind:
    """One layout, or one form of it; patterns of files are from the scene's folder.

    Attributes:
        layout: Name of its writer.
        format: The data manager that reads it.
        images: Of its images.
        depths: Of its depth files; empty where there are none.
        poses: The file of its poses; empty where it is binary.
        size: The file that says how large images are; empty: the first image.
        scene: Where in the folder that is written the scene's folder is.
        params: EndoGSLAM's result.
        accuracy: Of depth, mm: half a step, and where images are undistorted, up to half a stored pixel beside the ray.
        prepare: What makes another form of the layout.
    """

    layout: str
    format: str
    images: str
    depths: str
    poses: str
    size: str = ""
    scene: str = "."
    params: str = ""
    accuracy: float = 0.0
    prepare: Spoil | None = None

    @property
    def is_undistorted(self) -> bool:
        """Whether images are undistorted when they are read."""
        return self.accuracy > 0.5


def change_matrices(change: Callable[[np.ndarray], Any], name: str = "pose.txt") -> Spoil:
    """Change the matrices of a C3VD pose file as they are stored; in place, or by what is returned. [N, 4, 4]"""

    def spoil(folder: Path) -> None:
        matrices = np.loadtxt(folder / name, delimiter=",").reshape(-1, 4, 4)
        changed = change(matrices)
        rows = matrices if changed is None else changed
        (folder / name).write_text("".join(",".join(f"{value:.9g}" for value in row.ravel()) + "\n" for row in rows))

    return spoil


def _as_text(folder: Path) -> None:
    pycolmap.Reconstruction(str(folder / "sparse/0")).write_text(str(folder / "sparse/0"))
    remove("sparse/0/*.bin")(folder)


def _in_order(folder: Path) -> None:
    """Frame numbers for names, as Gaussian Pancakes has them."""
    for part in ("rgb", "depth"):
        for index, path in enumerate(sorted((folder / part).iterdir())):
            path.rename(path.with_name(f"{index}.png"))
    rows = [line.split()[1:] for line in (folder / "groundtruth.txt").read_text().splitlines() if line[0] != "#"]
    (folder / "groundtruth.txt").write_text("".join(f"{index} {' '.join(row)}\n" for index, row in enumerate(rows)))


_RAW = ("c3vd-raw", "c3vd", "*_color.png", "*_depth.tiff", "pose.txt")
_RGBD = ("rgbd", "rgbd", "rgb/*.png", "depth/*.png", "groundtruth.txt", "camera.json")
_COLMAP = ("colmap", "colmap", "images/*.png", "")
_ENDOGSLAM = ("c3vd-endogslam", "color/*.png", "depth/*.tiff")
KINDS = {
    "c3vd": Kind("c3vd", "c3vd", "images/*.png", "depths/*.png", "camera_pose.txt", "camera.json", accuracy=0.001),
    "c3vd-raw": Kind(*_RAW, accuracy=1.5),
    # C3VD's release under review: matrices row by row.
    "c3vd-raw-old": Kind(*_RAW, accuracy=1.5, prepare=change_matrices(lambda matrices: matrices.transpose(0, 2, 1))),
    "c3vd-v2": Kind("c3vd-v2", "c3vd-v2", "rgb/*.png", "depth/*.tiff", "pose.txt", accuracy=1.6),
    # A step is 0.39 mm, rounded down.
    "c3vd-endogslam": Kind("endogslam", *_ENDOGSLAM, "pose.txt", params="params.npz", accuracy=0.4),
    "pr-endo": Kind(
        *("pr-endo", *_ENDOGSLAM, "", "", "C3VD/phantom"),
        params="../../C3VD_endogslam_optimized/phantom/params.npz",
        accuracy=0.4,
    ),
    "rotatecolon": Kind(
        *("rotatecolon", "rotatecolon", "train_views/*.png", "depth_train/*.exr", "transforms.json"), accuracy=1e-4
    ),
    "colmap": Kind(*_COLMAP, "", "cameras.bin"),
    "colmap-text": Kind(*_COLMAP, "sparse/0/images.txt", "cameras.txt", prepare=_as_text),
    "endomapper": Kind(
        *("endomapper", "endomapper", "rgb/*.png", "depth/*.png", "trajectory.txt", "calibration.xml"), accuracy=2.0
    ),
    "nerfstudio": Kind(
        *("nerfstudio", "nerfstudio", "images/*.png", "depth/*.png", *["transforms.json"] * 2), accuracy=0.7
    ),
    "rgbd": Kind(*_RGBD, accuracy=0.0011),
    "rgbd-by-order": Kind(*_RGBD, accuracy=0.0011, prepare=_in_order),
    "reim-nerf": Kind(
        *("reim-nerf", "reim-nerf", "images/*.png", "distmaps/*.png", *["transforms_train.json"] * 2), accuracy=1.5
    ),
}


def write_kind(folder: Path, name: str, frames: int = FRAMES) -> Path:
    """The wall in a kind; the folder of its scene."""
    kind = KINDS[name]
    write_wall(folder, kind.layout, frames)
    if kind.prepare is not None:
        kind.prepare(folder)
    return folder / kind.scene


def files(folder: Path, pattern: str) -> list[Path]:
    """Matching files, at least one, as people count: 2 before 10."""
    found = sorted(folder.glob(pattern), key=lambda path: [int(digits) for digits in re.findall(r"\d+", path.name)])
    assert found, pattern
    return found


# Damage


def repaint(pattern: str, place: int, change: Callable[[np.ndarray], np.ndarray]) -> Spoil:
    """Change the pixels of one file; of an EXR file, those of every channel."""

    def spoil(folder: Path) -> None:
        path = files(folder, pattern)[place]
        if path.suffix == ".exr":
            change_exr(path, lambda name, pixels: (name, change(pixels)))
        else:
            assert cv2.imwrite(str(path), change(cv2.imread(str(path), cv2.IMREAD_UNCHANGED)))

    return spoil


def change_exr(path: Path, change: Callable[[str, np.ndarray], tuple[str, np.ndarray]]) -> None:
    """Change the names and pixels of an EXR file's channels."""
    with OpenEXR.File(str(path), separate_channels=True) as file:
        channels = {name: np.array(channel.pixels) for name, channel in file.parts[0].channels.items()}
    write_exr(path, dict(change(name, pixels) for name, pixels in channels.items()))


def half_size(pixels: np.ndarray) -> np.ndarray:
    return np.ascontiguousarray(pixels[::2, ::2])


def three_channels(pixels: np.ndarray) -> np.ndarray:
    return np.dstack([pixels] * 3)


def cut(pattern: str, place: int = 0, share: float = 0.6) -> Spoil:
    """Leave the first part of a file."""

    def spoil(folder: Path) -> None:
        path = files(folder, pattern)[place]
        data = path.read_bytes()
        path.write_bytes(data[: int(len(data) * share)])

    return spoil


def write(name: str, content: str | bytes) -> Spoil:
    """Replace the content of a file."""
    return lambda folder: (folder / name).write_bytes(content if isinstance(content, bytes) else content.encode())


def edit(name: str, old: str, new: str) -> Spoil:
    """Replace what matches a pattern in a text file."""

    def spoil(folder: Path) -> None:
        text, count = re.subn(old, new, (folder / name).read_text())
        assert count > 0
        (folder / name).write_text(text)

    return spoil


def copy(pattern: str, name: str) -> Spoil:
    """Copy the first of some files within its folder."""
    return lambda folder: shutil.copy(path := files(folder, pattern)[0], path.with_name(name))


def renumber(*patterns: str, change: Callable[[int], object] = int) -> Spoil:
    """Change the first number in the names of files; by default, take its zeros away."""

    def spoil(folder: Path) -> None:
        for path in [path for pattern in patterns if pattern for path in reversed(files(folder, pattern))]:
            path.rename(path.with_name(re.sub(r"\d+", lambda found: str(change(int(found[0]))), path.name, count=1)))

    return spoil


def remove(pattern: str, place: int | None = None) -> Spoil:
    """Delete one file, or all that match."""
    return lambda folder: [
        path.unlink() for index, path in enumerate(files(folder, pattern)) if place is None or index == place
    ]


def clear(folder: Path) -> None:
    """Delete all there is."""
    for path in folder.iterdir():
        shutil.rmtree(path) if path.is_dir() else path.unlink()


def change_lines(name: str, change: Callable[[list[str]], list[str]]) -> Spoil:
    """Change the lines of a text file."""
    return lambda folder: (folder / name).write_text("\n".join(change((folder / name).read_text().splitlines())) + "\n")


def change_row(name: str, place: int, first: int, change: Callable[[np.ndarray], np.ndarray]) -> Spoil:
    """Change four numbers, from the column ``first`` on, of a row that is no comment: a quaternion."""

    def changed(lines: list[str]) -> list[str]:
        row = [index for index, line in enumerate(lines) if line.strip() and line[0] != "#"][place]
        words = lines[row].split()
        words[first : first + 4] = [repr(float(value)) for value in change(np.array(words[first : first + 4], float))]
        return [*lines[:row], " ".join(words), *lines[row + 1 :]]

    return change_lines(name, changed)


def change_json(pattern: str, change: Callable[[dict[str, Any]], Any] = lambda content: None, **values: Any) -> Spoil:
    """Change the content of JSON files, in place, and set keys; None removes one."""

    def spoil(folder: Path) -> None:
        for path in files(folder, pattern):
            content = json.loads(path.read_text())
            change(content)
            content.update(values)
            path.write_text(
                json.dumps({key: value for key, value in content.items() if key not in values or value is not None})
            )

    return spoil


def change_frames(pattern: str, change: Callable[[int, dict[str, Any]], Any]) -> Spoil:
    """Change the entries of the frames of JSON files, in place, by their index."""
    return change_json(pattern, lambda content: [change(*entry) for entry in enumerate(content["frames"])])


def change_frame(pattern: str, place: int, change: Callable[[np.ndarray], Any]) -> Spoil:
    """Change the matrix of a frame, in place."""

    def spoil(content: dict[str, Any]) -> None:
        matrix = np.array(content["frames"][place]["transform_matrix"])
        change(matrix)
        content["frames"][place]["transform_matrix"] = matrix.tolist()

    return change_json(pattern, spoil)


def change_npz(name: str, change: Callable[[dict[str, np.ndarray]], Any]) -> Spoil:
    """Change the arrays of an NPZ file, in place."""

    def spoil(folder: Path) -> None:
        with np.load(folder / name) as file:
            arrays = dict(file)
        change(arrays)
        np.savez(folder / name, **arrays)

    return spoil


def change_model(change: Callable[[pycolmap.Reconstruction], pycolmap.Reconstruction | None]) -> Spoil:
    """Change a COLMAP model, in place or by what is returned."""

    def spoil(folder: Path) -> None:
        model = pycolmap.Reconstruction(str(folder / "sparse/0"))
        (change(model) or model).write_binary(str(folder / "sparse/0"))

    return spoil


def change_binary_pose(place: int, change: Callable[[np.ndarray], np.ndarray]) -> Spoil:
    """Change the seven numbers of an image's pose in ``images.bin``: quaternion, w first, and translation."""

    def spoil(folder: Path) -> None:
        path = folder / "sparse/0/images.bin"
        data, at = bytearray(path.read_bytes()), 8
        for _ in range(place):
            end = data.index(b"\0", at + 64)
            at = end + 9 + 24 * struct.unpack_from("<Q", data, end + 1)[0]
        struct.pack_into("<7d", data, at + 4, *change(np.array(struct.unpack_from("<7d", data, at + 4))))
        path.write_bytes(bytes(data))

    return spoil
