"""Scenes in every layout, and ways of spoiling one: what real folders suffer from."""

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
import pycolmap

from tests.phantom.phantom_layouts import write_phantom

WIDTH, HEIGHT, FRAMES = 64, 51, 11

Spoil = Callable[[Path], Any]


@dataclass(frozen=True)
class Kind:
    """One layout, or one form of it.

    Attributes:
        layout: Of the phantom.
        format: The data manager that reads it.
        images: Glob of the images, from the scene's folder.
        depths: Glob of the depth files; empty where there are none.
        poses: The pose file; empty where spoiling it is of no use.
        scene: Where in the phantom the scene's folder is.
        params: EndoGSLAM's result, from the scene's folder; empty where there is none.
        prepare: What makes another form of the layout.
    """

    layout: str
    format: str
    images: str
    depths: str
    poses: str
    scene: str = "."
    params: str = ""
    prepare: Spoil | None = None


def _rows(folder: Path) -> None:
    """C3VD's release under review: matrices row by row."""
    change_matrices("pose.txt", lambda matrices: matrices.transpose(0, 2, 1))(folder)


def _unpadded(folder: Path) -> None:
    """cecum_t1_a's names in the release."""
    for path in folder.glob("*_color.png"):
        path.rename(path.with_name(f"{int(path.name[:4])}_color.png"))


def _text_model(folder: Path) -> None:
    """The same model in text files."""
    place = folder / "sparse/0"
    pycolmap.Reconstruction(str(place)).write_text(str(place))
    for path in place.glob("*.bin"):
        path.unlink()


def _in_order(folder: Path) -> None:
    """Frame numbers for names, as Gaussian Pancakes has them."""
    for part in ("rgb", "depth"):
        for index, path in enumerate(sorted((folder / part).iterdir())):
            path.rename(path.with_name(f"{index}.png"))
    rows = [line.split() for line in _lines(folder / "groundtruth.txt") if not line.startswith("#")]
    text = "\n".join(" ".join([str(index), *row[1:]]) for index, row in enumerate(rows))
    (folder / "groundtruth.txt").write_text(text + "\n")


KINDS = {
    "c3vd": Kind("c3vd", "c3vd", "images/*.png", "depths/*.png", "camera_pose.txt"),
    "c3vd-raw": Kind("c3vd-raw", "c3vd", "*_color.png", "*_depth.tiff", "pose.txt"),
    "c3vd-raw-old": Kind("c3vd-raw", "c3vd", "*_color.png", "*_depth.tiff", "pose.txt", prepare=_rows),
    "c3vd-v2": Kind("c3vd-v2", "c3vd-v2", "rgb/*.png", "depth/*.tiff", "pose.txt"),
    "c3vd-endogslam": Kind(
        "endogslam", "c3vd-endogslam", "color/*.png", "depth/*.tiff", "pose.txt", params="params.npz"
    ),
    "pr-endo": Kind(
        *("pr-endo", "c3vd-endogslam", "color/*.png", "depth/*.tiff", "", "C3VD/phantom"),
        params="../../C3VD_endogslam_optimized/phantom/params.npz",
    ),
    "rotatecolon": Kind("rotatecolon", "rotatecolon", "train_views/*.png", "depth_train/*.exr", "transforms.json"),
    "colmap": Kind("colmap", "colmap", "images/*.png", "", ""),
    "colmap-text": Kind("colmap", "colmap", "images/*.png", "", "sparse/0/images.txt", prepare=_text_model),
    "endomapper": Kind("endomapper", "endomapper", "rgb/*.png", "depth/*.png", "trajectory.txt"),
    "nerfstudio": Kind("nerfstudio", "nerfstudio", "images/*.png", "depth/*.png", "transforms.json"),
    "rgbd": Kind("rgbd", "rgbd", "rgb/*.png", "depth/*.png", "groundtruth.txt"),
    "rgbd-by-order": Kind("rgbd", "rgbd", "rgb/*.png", "depth/*.png", "groundtruth.txt", prepare=_in_order),
    "reim-nerf": Kind("reim-nerf", "reim-nerf", "images/*.png", "distmaps/*.png", "transforms_train.json"),
}


def write_all(folder: Path, frames: int = FRAMES) -> dict[str, Path]:
    """The phantom in every kind: the folder to copy, by the kind's name."""
    layouts = {kind.layout for kind in KINDS.values()}
    coarse = {"mesh_spacing": 3.0, "texture_spacing": 1.0}
    made = {
        layout: write_phantom(folder / layout, layout, WIDTH, HEIGHT, frames=frames, **coarse) for layout in layouts
    }
    found = {}
    for name, kind in KINDS.items():
        found[name] = made[kind.layout]
        if kind.prepare is not None:
            found[name] = Path(shutil.copytree(made[kind.layout], folder / name / "scene"))
            kind.prepare(found[name])
    return found


def files(folder: Path, pattern: str) -> list[Path]:
    """Matching files, as people count: 2 before 10."""
    return sorted(folder.glob(pattern), key=lambda path: [int(digits) for digits in re.findall(r"\d+", path.name)])


# Images


def repaint(pattern: str, place: int, change: Callable[[np.ndarray], np.ndarray]) -> Spoil:
    """Change the pixels of one file."""

    def spoil(folder: Path) -> None:
        path = files(folder, pattern)[place]
        if path.suffix == ".exr":
            _change_exr(path, lambda channels: {name: change(pixels) for name, pixels in channels.items()})
            return
        assert cv2.imwrite(str(path), change(cv2.imread(str(path), cv2.IMREAD_UNCHANGED)))

    return spoil


def half_size(pixels: np.ndarray) -> np.ndarray:
    """Every other pixel."""
    return np.ascontiguousarray(pixels[::2, ::2])


def three_channels(pixels: np.ndarray) -> np.ndarray:
    """A grey image saved as a colour one."""
    return np.dstack([pixels] * 3)


def grey(pixels: np.ndarray) -> np.ndarray:
    """A colour image saved as a grey one."""
    return np.ascontiguousarray(pixels[..., 0])


def square(pixels: np.ndarray) -> np.ndarray:
    """A crop."""
    return np.ascontiguousarray(pixels[:50, :50])


def paint(name: str, shape: tuple[int, ...]) -> Spoil:
    """Write a black image."""
    return lambda folder: cv2.imwrite(str(folder / name), np.zeros(shape, np.uint8))


def rename_channel(pattern: str, place: int, old: str, new: str) -> Spoil:
    """Give a channel of an EXR file another name."""

    def spoil(folder: Path) -> None:
        _change_exr(
            files(folder, pattern)[place],
            lambda channels: {new if name == old else name: pixels for name, pixels in channels.items()},
        )

    return spoil


def _change_exr(path: Path, change: Callable[[dict[str, np.ndarray]], dict[str, np.ndarray]]) -> None:
    import OpenEXR

    with OpenEXR.File(str(path), separate_channels=True) as file:
        channels = {name: np.array(channel.pixels) for name, channel in file.parts[0].channels.items()}
    header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
    OpenEXR.File(header, change(channels)).write(str(path))


def cut(pattern: str, place: int = 0, share: float = 0.6, lines: int | None = None) -> Spoil:
    """Leave the beginning of a file: a share of its bytes, or some lines."""

    def spoil(folder: Path) -> None:
        path = files(folder, pattern)[place]
        data = path.read_bytes()
        path.write_bytes(
            data[: int(len(data) * share)] if lines is None else b"".join(data.splitlines(keepends=True)[:lines])
        )

    return spoil


def write_text(name: str, content: str | bytes) -> Spoil:
    """Replace the content of a file."""
    return lambda folder: (folder / name).write_bytes(content if isinstance(content, bytes) else content.encode())


def edit(name: str, old: str, new: str) -> Spoil:
    """Replace what matches a pattern in a text file."""

    def spoil(folder: Path) -> None:
        text, count = re.subn(old, new, (folder / name).read_text())
        assert count > 0
        (folder / name).write_text(text)

    return spoil


def rename(patterns: list[str], change: Callable[[int], object]) -> Spoil:
    """Change the first number in the names of files."""

    def spoil(folder: Path) -> None:
        for pattern in patterns:
            renamed = {
                path: re.sub(r"\d+", lambda match: str(change(int(match[0]))), path.name, count=1)
                for path in files(folder, pattern)
            }
            for path in renamed:
                path.rename(path.with_name(f"aside-{path.name}"))
            for path, name in renamed.items():
                path.with_name(f"aside-{path.name}").rename(path.with_name(name))

    return spoil


def remove(pattern: str, place: int | None = None) -> Spoil:
    """Delete one file, or all that match."""

    def spoil(folder: Path) -> None:
        found = files(folder, pattern)
        assert found
        for path in found if place is None else [found[place]]:
            path.unlink()

    return spoil


def clear(folder: Path) -> None:
    """Delete all there is."""
    for path in folder.iterdir():
        shutil.rmtree(path) if path.is_dir() else path.unlink()


# Poses in text


def _lines(path: Path) -> list[str]:
    return path.read_text().splitlines()


def drop_last_line(name: str, count: int = 1) -> Spoil:
    """Fewer poses than images."""
    return lambda folder: (folder / name).write_text("\n".join(_lines(folder / name)[:-count]) + "\n")


def repeat_last_line(name: str) -> Spoil:
    """More poses than images."""
    return lambda folder: (folder / name).write_text("\n".join([*_lines(folder / name), _lines(folder / name)[-1]]))


def change_line(name: str, number: int, text: str) -> Spoil:
    """Replace a line."""

    def spoil(folder: Path) -> None:
        lines = _lines(folder / name)
        lines[number] = text
        (folder / name).write_text("\n".join(lines))

    return spoil


def change_matrices(name: str, change: Callable[[np.ndarray], np.ndarray | None]) -> Spoil:
    """Change the matrices of a C3VD pose file as they are stored; in place, or by what is returned. [N, 4, 4]"""

    def spoil(folder: Path) -> None:
        path = folder / name
        matrices = np.loadtxt(path, delimiter=",").reshape(-1, 4, 4)
        changed = change(matrices)
        matrices = matrices if changed is None else changed
        rows = [",".join(f"{value:.9g}" for value in matrix.ravel()) for matrix in matrices]
        path.write_text("\n".join(rows) + "\n")

    return spoil


def change_row(name: str, place: int, first: int, change: Callable[[np.ndarray], np.ndarray]) -> Spoil:
    """Change four numbers, from the column ``first`` on, of a row that is no comment: a quaternion."""

    def spoil(folder: Path) -> None:
        lines = _lines(folder / name)
        rows = [index for index, line in enumerate(lines) if line.strip() and not line.startswith("#")]
        words = lines[rows[place]].split()
        values = change(np.array(words[first : first + 4], float))
        words[first : first + 4] = [repr(float(value)) for value in values]
        lines[rows[place]] = " ".join(words)
        (folder / name).write_text("\n".join(lines) + "\n")

    return spoil


# Poses and cameras in JSON


def change_json(pattern: str, change: Callable[[dict[str, Any]], Any]) -> Spoil:
    """Change the content of JSON files, in place."""

    def spoil(folder: Path) -> None:
        found = sorted(folder.glob(pattern))
        assert found
        for path in found:
            content = json.loads(path.read_text())
            change(content)
            path.write_text(json.dumps(content))

    return spoil


def change_camera(pattern: str = "camera.json", **values: Any) -> Spoil:
    """Set keys of JSON files; None removes one."""

    def spoil(content: dict[str, Any]) -> None:
        content.update(values)
        for key in [key for key, value in values.items() if value is None]:
            del content[key]

    return change_json(pattern, spoil)


def change_frame(pattern: str, place: int, change: Callable[[np.ndarray], Any]) -> Spoil:
    """Change the matrix of a frame, in place."""

    def spoil(content: dict[str, Any]) -> None:
        matrix = np.array(content["frames"][place]["transform_matrix"])
        change(matrix)
        content["frames"][place]["transform_matrix"] = matrix.tolist()

    return change_json(pattern, spoil)


def stretch(matrix: np.ndarray) -> None:
    """No rotation any more: all of it twice as long."""
    matrix[..., :3, :3] *= 2.0


def mirror(matrix: np.ndarray) -> None:
    """Left-handed: one camera axis turned round."""
    matrix[..., :3, 0] *= -1.0


def mirror_rows(matrix: np.ndarray) -> None:
    """The same in matrices that are stored by columns."""
    matrix[..., 0, :3] *= -1.0


def spoil_number(matrix: np.ndarray) -> None:
    """Not a number among the others."""
    matrix[..., 0, 0] = np.nan


# Arrays and binary models


def change_npz(name: str, change: Callable[[dict[str, np.ndarray]], Any]) -> Spoil:
    """Change the arrays of an NPZ file, in place."""

    def spoil(folder: Path) -> None:
        with np.load(folder / name) as file:
            arrays = dict(file)
        change(arrays)
        np.savez(folder / name, allow_pickle=False, **arrays)

    return spoil


def shorten(arrays: dict[str, np.ndarray], by: int) -> None:
    """EndoGSLAM's result without its last frames."""
    for key in ("cam_unnorm_rots", "cam_trans"):
        arrays[key] = arrays[key][..., :-by]
    arrays["gt_w2c_all_frames"] = arrays["gt_w2c_all_frames"][:-by]


def double_colmap(size: bool) -> Spoil:
    """Double a model's focal lengths and principal points and, optionally, its image sizes."""

    def spoil(folder: Path) -> None:
        model = pycolmap.Reconstruction(str(folder / "sparse/0"))
        for camera in model.cameras.values():
            if size:
                camera.rescale(2.0)
            else:
                camera.params = 2.0 * camera.params
        model.write_binary(str(folder / "sparse/0"))

    return spoil


def change_binary_pose(place: int, change: Callable[[np.ndarray], np.ndarray]) -> Spoil:
    """Change the seven numbers of an image's pose in ``images.bin``: quaternion, w first, and translation."""

    def spoil(folder: Path) -> None:
        path = folder / "sparse/0/images.bin"
        data = bytearray(path.read_bytes())
        at = 8
        for _ in range(place):
            end = data.index(b"\0", at + 64)
            (points,) = struct.unpack_from("<Q", data, end + 1)
            at = end + 9 + 24 * points
        values = change(np.array(struct.unpack_from("<7d", data, at + 4)))
        struct.pack_into("<7d", data, at + 4, *values)
        path.write_bytes(bytes(data))

    return spoil


def unregistered(folder: Path) -> None:
    """A model of which no image was registered."""
    place = folder / "sparse/0"
    empty = pycolmap.Reconstruction()
    for camera in pycolmap.Reconstruction(str(place)).cameras.values():
        empty.add_camera_with_trivial_rig(camera)
    for path in place.iterdir():
        path.unlink()
    empty.write_binary(str(place))
