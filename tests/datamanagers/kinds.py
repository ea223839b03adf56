"""Every layout that is read, and forms of it: where its files are, and the faults that can befall a folder.

A fault is the damage and what is said of it: a message names the file, what was seen in it and what would be right.
"""

from __future__ import annotations

import json
import re
import shutil
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import OpenEXR
import pycolmap

from tests.datamanagers.wall_scenes import FRAMES, write_wall
from tests.layouts import write_exr

Spoil = Callable[[Path], Any]


@dataclass(frozen=True)
class Kind:
    """One layout, or one form of it; patterns of files are from the scene's folder."""

    layout: str  # name of its writer
    format: str  # the data manager that reads it
    images: str
    depths: str  # empty where there are none
    poses: str  # the file of its poses; empty where it is binary
    size: str = ""  # the file that says how large images are; empty: the first image
    scene: str = "."  # where in the folder that is written the scene's folder is
    params: str = ""  # EndoGSLAM's result
    #: Of depth, mm: half a step, and where images are undistorted, up to half a stored pixel beside the ray.
    accuracy: float = 0.0
    prepare: Spoil | None = None  # what makes another form of the layout
    groups: str = ""  # names of GROUPS that it is in, whose faults it shares
    test: tuple[int, ...] = (0, 8)  # frames of the video that are held out by default
    seen_split: str = "every-8th"  # that its seen masks are for
    has_own_tests: bool = False  # test views are apart from the video
    image_name: Callable[[int], str] = r"0*{}(_color|_depth)?".format  # pattern of the name of the image of a place

    @property
    def is_undistorted(self) -> bool:
        """True if images are undistorted when they are read."""
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


def beside(*names: str) -> Spoil:
    """Put files of a release beside those that are read."""

    def spoil(folder: Path) -> None:
        for path in (folder / name for name in names):
            path.parent.mkdir(exist_ok=True)
            path.write_text("not looked at")

    return spoil


_RELEASE = beside("0001_flow.tiff", "0000_occlusion.png", "coverage_mesh.obj", "color.png", "diffuse/0000_x.tiff")
_RAW = ("c3vd-raw", "c3vd", "*_color.png", "*_depth.tiff", "pose.txt")
_RGBD = ("rgbd", "rgbd", "rgb/*.png", "depth/*.png", "groundtruth.txt", "camera.json")
_COLMAP = ("colmap", "colmap", "images/*.png", "")
_ENDOGSLAM = ("c3vd-endogslam", "color/*.png", "depth/*.tiff")
_MATRICES = "matrices paired depth-16"
_MAPPED: dict[str, Any] = {"test": (7,), "seen_split": "endogslam"}
KINDS = {
    "c3vd": Kind(
        *("c3vd", "c3vd", "images/*.png", "depths/*.png", "camera_pose.txt", "camera.json"),
        accuracy=0.001,
        groups=f"{_MATRICES} camera.json",
    ),
    "c3vd-raw": Kind(*_RAW, accuracy=1.5, prepare=_RELEASE, groups=_MATRICES),
    # C3VD's release under review: matrices row by row.
    "c3vd-raw-old": Kind(
        *_RAW,
        accuracy=1.5,
        prepare=change_matrices(lambda matrices: matrices.transpose(0, 2, 1)),
        groups=_MATRICES,
    ),
    "c3vd-v2": Kind(
        *("c3vd-v2", "c3vd-v2", "rgb/*.png", "depth/*.tiff", "pose.txt"),
        accuracy=1.6,
        prepare=_RELEASE,
        groups=_MATRICES,
    ),
    # A step is 0.39 mm, rounded down.
    "c3vd-endogslam": Kind(
        *("endogslam", *_ENDOGSLAM, "pose.txt"),
        params="params.npz",
        accuracy=0.4,
        prepare=beside(*(f"{part}/0000_x.png" for part in ("color_raw", "depth_raw", "normals", "flow", "occlusion"))),
        groups="matrices paired params",
        **_MAPPED,
    ),
    "pr-endo": Kind(
        *("pr-endo", *_ENDOGSLAM, "", "", "C3VD/phantom"),
        params="../../C3VD_endogslam_optimized/phantom/params.npz",
        accuracy=0.4,
        groups="paired params",
        **_MAPPED,
    ),
    "rotatecolon": Kind(
        *("rotatecolon", "rotatecolon", "train_views/*.png", "depth_train/*.exr", "transforms.json"),
        accuracy=1e-4,
        groups="json",
        test=(),
        seen_split="all-train",
        has_own_tests=True,
    ),
    "colmap": Kind(*_COLMAP, "", "cameras.bin", groups="both-colmap"),
    "colmap-text": Kind(*_COLMAP, "sparse/0/images.txt", "cameras.txt", prepare=_as_text, groups="both-colmap"),
    "endomapper": Kind(
        *("endomapper", "endomapper", "rgb/*.png", "depth/*.png", "trajectory.txt", "calibration.xml"),
        accuracy=2.0,
        groups="tum by-order depth-16",
    ),
    "nerfstudio": Kind(
        *("nerfstudio", "nerfstudio", "images/*.png", "depth/*.png", *["transforms.json"] * 2),
        accuracy=0.7,
        groups="json depth-16",
        image_name=lambda place: f"frame_{place + 1:05d}",
    ),
    "rgbd": Kind(
        *_RGBD,
        accuracy=0.0011,
        groups="tum camera.json depth-16",
        image_name=lambda place: f"{1_305_031_102 + place / 30:.6f}",
    ),
    "rgbd-by-order": Kind(*_RGBD, accuracy=0.0011, prepare=_in_order, groups="tum by-order camera.json"),
    "reim-nerf": Kind(
        *("reim-nerf", "reim-nerf", "images/*.png", "distmaps/*.png", *["transforms_train.json"] * 2),
        accuracy=1.5,
        groups="json depth-16",
        test=(1, 2, 3, 4, 6, 7, 8, 9),
        seen_split="own",
    ),
}
#: Kinds by what they have in common: poses of sixteen numbers a line or in frames of a JSON file, TUM's trajectory and
#: whether line n of it belongs to image n, a camera.json, EndoGSLAM's result, and depth for every image of a number.
GROUPS: dict[str, tuple[str, ...]] = {
    "all": tuple(KINDS),
    "depth": tuple(name for name, kind in KINDS.items() if kind.depths),
    **{
        group: tuple(name for name, kind in KINDS.items() if group in kind.groups.split())
        for group in {group for kind in KINDS.values() for group in kind.groups.split()}
    },
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
    matches = sorted(folder.glob(pattern), key=lambda path: [int(digits) for digits in re.findall(r"\d+", path.name)])
    assert matches, pattern
    return matches


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
    with OpenEXR.File(str(path), separate_channels=True) as file:
        channels = {name: np.array(channel.pixels) for name, channel in file.parts[0].channels.items()}
    write_exr(path, dict(change(name, pixels) for name, pixels in channels.items()))


def half_size(pixels: np.ndarray) -> np.ndarray:
    return np.ascontiguousarray(pixels[::2, ::2])


def three_channels(pixels: np.ndarray) -> np.ndarray:
    return np.dstack([pixels] * 3)


def cut(pattern: str, place: int = 0, share: float = 0.6) -> Spoil:
    def spoil(folder: Path) -> None:
        path = files(folder, pattern)[place]
        data = path.read_bytes()
        path.write_bytes(data[: int(len(data) * share)])

    return spoil


def write(name: str, content: str | bytes) -> Spoil:
    return lambda folder: (folder / name).write_bytes(content if isinstance(content, bytes) else content.encode())


def edit(name: str, old: str, new: str) -> Spoil:
    def spoil(folder: Path) -> None:
        text, count = re.subn(old, new, (folder / name).read_text())
        assert count > 0
        (folder / name).write_text(text)

    return spoil


def copy(pattern: str, name: str) -> Spoil:
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
    for path in folder.iterdir():
        shutil.rmtree(path) if path.is_dir() else path.unlink()


def change_lines(name: str, change: Callable[[list[str]], list[str]]) -> Spoil:
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
    def spoil(content: dict[str, Any]) -> None:
        matrix = np.array(content["frames"][place]["transform_matrix"])
        change(matrix)
        content["frames"][place]["transform_matrix"] = matrix.tolist()

    return change_json(pattern, spoil)


def change_npz(name: str, change: Callable[[dict[str, np.ndarray]], Any]) -> Spoil:
    def spoil(folder: Path) -> None:
        with np.load(folder / name) as file:
            arrays = dict(file)
        change(arrays)
        np.savez(folder / name, **arrays)

    return spoil


def change_model(change: Callable[[pycolmap.Reconstruction], pycolmap.Reconstruction | None]) -> Spoil:
    def spoil(folder: Path) -> None:
        model = pycolmap.Reconstruction(str(folder / "sparse/0"))
        (change(model) or model).write_binary(str(folder / "sparse/0"))

    return spoil


def scale_pose(number: int, factor: float) -> Spoil:
    """Multiply the quaternion and translation of an image's pose in a COLMAP model."""

    def change(model: pycolmap.Reconstruction) -> None:
        image = model.images[number]
        pose = image.cam_from_world()
        turn = pycolmap.Rotation3d(factor * pose.rotation.quat)
        image.frame.set_cam_from_world(image.camera_id, pycolmap.Rigid3d(turn, factor * pose.translation))

    return change_model(change)


# Faults

RUBBISH = bytes(range(256))


def expanded(table: str, damages: Mapping[str, Callable[[Kind], Spoil]]) -> dict[tuple[str, str], tuple[Spoil, str]]:
    """Damage and pattern by fault and kind.

    Behind or below each fault stand the kinds that it befalls, or their groups, and the pattern of the message. In it,
    ``<3>`` is the name of image 3, ``<size>`` the file that says how large images are and ``<poses>`` the pose file.
    """
    result, fault = {}, ""
    for line in table.splitlines():
        if not line.startswith(" "):
            fault = line.partition(" | ")[0]
        groups, _, message = line.removeprefix(f"{fault} | ").removeprefix(fault).strip().partition(": ")
        for name in [name for group in filter(None, groups.split(", ")) for name in GROUPS.get(group, (group,))]:
            kind = KINDS[name]
            pattern = message.replace("<size>", kind.size or r"<0>\.png").replace("<poses>", kind.poses)
            pattern = re.sub(r"<(\d)>", lambda match, kind=kind: kind.image_name(int(match[1])), pattern)
            result[fault, name] = damages[fault](kind), pattern
    return result


def doubled(*keys: str) -> Callable[[dict], None]:
    return lambda content: content.update({key: 2 * content[key] for key in keys if key in content})


TWICE = ("fx", "fy", "cx", "cy", "fl_x", "fl_y")
TURNED = [[0.0, -1.0, 0.0, 0.0], [1.0, 0.0, 0.0, 0.0], [0.0, 0.0, 1.0, 0.0], [0.0, 0.0, 0.0, 1.0]]


def scaled(factor: float, *place: int | slice) -> Callable[[np.ndarray], None]:
    """Multiply a part of a matrix, in place: 2 leaves no rotation, -1 of one axis a left-handed one."""

    def change(matrix: np.ndarray) -> None:
        matrix[place] *= factor

    return change


MIRROR = scaled(-1.0, slice(3), 0)


def one_pose(matrix: Callable[[np.ndarray], None], factor: float) -> Callable[[Kind], Spoil]:
    """Change a matrix, in place, or, where poses are quaternions, multiply one."""

    def damage(kind: Kind) -> Spoil:
        if kind.format in GROUPS["json"]:
            return change_frame(kind.poses, 1, matrix)
        if kind.format in ("rgbd", "endomapper"):
            return change_row(kind.poses, 3, 4, lambda quaternion: factor * quaternion)
        if kind is KINDS["colmap-text"]:
            return change_row(kind.poses, 6, 1, lambda quaternion: factor * quaternion)
        if kind is KINDS["colmap"]:
            return scale_pose(4, factor)
        if matrix is MIRROR and kind is not KINDS["c3vd-raw-old"]:
            return change_matrices(lambda matrices: MIRROR(matrices[3].T), kind.poses)
        return change_matrices(lambda matrices: matrix(matrices[3]), kind.poses)

    return damage


def result(change: Callable[[dict[str, np.ndarray]], object]) -> Callable[[Kind], Spoil]:
    return lambda kind: change_npz(kind.params, change)


def cameras(change: Callable[[pycolmap.Camera], object]) -> Callable[[pycolmap.Reconstruction], None]:
    return lambda model: [change(camera) for camera in model.cameras.values()] and None


def unregistered(model: pycolmap.Reconstruction) -> pycolmap.Reconstruction:
    empty = pycolmap.Reconstruction()
    for camera in model.cameras.values():
        empty.add_camera_with_trivial_rig(camera)
    return empty


def panoramic(_: pycolmap.Reconstruction) -> pycolmap.Reconstruction:
    model = pycolmap.Reconstruction()
    params = {"model": "EQUIRECTANGULAR", "width": 64, "height": 32, "params": [64, 32]}
    model.add_camera_with_trivial_rig(pycolmap.Camera(camera_id=1, **params))
    model.add_image_with_trivial_frame(pycolmap.Image(name="0.png", camera_id=1, image_id=1), pycolmap.Rigid3d())
    return model


def with_intrinsics(text: str) -> Spoil:
    return lambda folder: [remove("camera.json")(folder), write("intrinsics.txt", text)(folder)]


def shorten(arrays: dict[str, np.ndarray]) -> None:
    """EndoGSLAM's result without its last frames."""
    arrays |= {key: arrays[key][..., :-2] for key in ("cam_unnorm_rots", "cam_trans")}
    arrays["gt_w2c_all_frames"] = arrays["gt_w2c_all_frames"][:-2]


def fourth_without(key: str) -> Callable[[int, dict], object]:
    return lambda index, frame: index == 3 and frame.pop(key)


def frame(place: int, pattern: str, **values: object) -> Spoil:
    return change_frames(pattern, lambda index, entry: entry.update(values) if index == place else None)


#: Intrinsics, with the sizes of their images, of twice the resolution.
_TWICE_RESOLVED = {
    "c3vd-v2": edit("camera_intrinsics.txt", "cx = 677", "cx = 338"),
    "c3vd-endogslam": change_npz("params.npz", lambda arrays: scaled(2.0, slice(2))(arrays["intrinsics"])),
    "rotatecolon": change_json("transforms.json", camera_angle_x=80.0),
    "colmap": change_model(cameras(lambda camera: camera.rescale(2.0))),
    "endomapper": edit("calibration.xml", "> 40 <", "> 80 <"),
}
#: Other files than images and poses.
_OTHER = {
    "colmap": "sparse/0/points3D.bin",
    "rotatecolon": "init_point_cloud.ply",
    "reim-nerf": "rgb_mask.png",
    "c3vd": "rotation/camera_pose.txt",
    "c3vd-v2": "rotation/rgb/*.png",
    "c3vd-endogslam": "rotation/pose.txt",
}
_CAMERAS = {"c3vd-v2": "camera_intrinsics.txt", "colmap": "sparse/0/cameras.bin"}

#: Faults that can befall several layouts.
DAMAGES: dict[str, Callable[[Kind], Spoil]] = {
    "an image of another size": lambda k: repaint(k.images, 4, half_size),
    "depth of another size": lambda k: repaint(k.depths, 0, half_size),
    "an image cut short": lambda k: cut(k.images, 4),
    "an image of one channel": lambda k: repaint(k.images, 4, lambda pixels: pixels[..., 0].copy()),
    "depth cut short": lambda k: cut(k.depths, 5),
    "depth of three channels": lambda k: repaint(k.depths, 5, three_channels),
    "depth of 8 bits": lambda k: repaint(k.depths, 5, lambda depth: (depth // 256).astype(np.uint8)),
    "depth of 16 bits": lambda k: repaint(k.depths, 5, lambda depth: depth.astype(np.uint16)),
    "depth missing for a frame": lambda k: remove(k.depths, 3),
    "no depth and no points": lambda k: remove(k.depths),
    "an empty folder": lambda k: clear,
    "no images": lambda k: remove(k.images),
    "an image that is gone": lambda k: remove(k.images, 3),
    "two images of one number": lambda k: lambda folder: copy(k.images, f"00{files(folder, k.images)[0].name}")(folder),
    "numbers from one on": lambda k: renumber(k.images, k.depths, change=lambda number: number + 1),
    "no pose file": lambda k: remove(k.poses),
    "fewer poses than images": lambda k: change_lines(k.poses, lambda rows: rows[:-1]),
    "a shorter result": result(shorten),
    "more poses than images": lambda k: change_lines(k.poses, lambda rows: [*rows, rows[-1]]),
    "more frames than images": lambda k: change_json(
        k.poses, lambda content: content["frames"].append({**content["frames"][-1], "file_path": "images/99"})
    ),
    "no poses": lambda k: write(k.poses, ""),
    "no frames": lambda k: change_json(k.poses, frames=[]),
    # The last observation of COLMAP's text loses its point; cut between two, the file is a whole one of fewer images.
    "poses cut short": lambda k: (
        edit(k.poses, r" \S+\s*\Z", "") if "sparse" in k.poses else cut(k.poses or "sparse/0/images.bin")
    ),
    "poses of something else": lambda k: write(k.poses, RUBBISH),
    "poses of another format": lambda k: write(k.poses, "1,0,0,0,0,1,0,0,0,0,1,0,0,0,0,1\n"),
    "a result of something else": lambda k: write(k.params, "PK nonsense"),
    "a number that is none": one_pose(scaled(np.nan, 0, 0), np.nan),
    "a result of no numbers": result(lambda arrays: arrays.update(cam_trans=arrays["cam_trans"] * np.nan)),
    "no matrix": lambda k: change_json(k.poses, lambda content: content["frames"][1].pop("transform_matrix")),
    "a rotation that is none": one_pose(scaled(2.0, slice(3), slice(3)), 2.0),
    "a quaternion of length 0": one_pose(MIRROR, 0.0),
    "a result of no rotation": result(lambda arrays: arrays["cam_unnorm_rots"][..., 3].fill(0.0)),
    "a left-handed pose": one_pose(MIRROR, 0.0),
    "a left-handed result": result(lambda arrays: MIRROR(arrays["gt_w2c_all_frames"][3])),
    "intrinsics of another resolution": lambda k: _TWICE_RESOLVED.get(
        k.format, change_json(k.size.replace("train", "*"), doubled(*TWICE, "w", "h"))
    ),
    "no camera file": lambda k: remove(k.size),
    "a camera cut short": lambda k: cut(_CAMERAS.get(k.format, k.size)),
    "a crop": lambda k: repaint(k.images, 0, lambda pixels: pixels[:30, :30].copy()),
    "another file cut short": lambda k: cut(_OTHER[k.format]),
    "a model without points": lambda k: change_lines("sparse/0/points3D.txt", lambda rows: rows[:100]),
    "a model without images": lambda k: change_model(unregistered),
    "no folder of images": lambda k: lambda folder: shutil.rmtree(folder / "images"),
    "no depth scale": lambda k: (
        change_json(k.size, depth_scale=None) if k.format == "rgbd" else edit(k.size, "<depth_.*", "")
    ),
}
SAID = r"""
an image of another size | all: <4>\.png is 20 x 16, but \S*<size> says 40 x 32.*of one size
depth of another size | depth: <0>\.(png|tiff|exr) is 20 x 16, but \S*<size> says 40 x 32
an image cut short | all: <4>\.png \(\d+ bytes\) cannot be decoded.*a complete image
an image of one channel | all: <4>\.png is an image of 1 channel of uint8
depth cut short | depth: <5>\.(png|tiff|exr) \(\d+ bytes\) cannot be decoded.*complete
depth of three channels
  params, depth-16: <5>\.(png|tiff) is an image of 3 channels of uint(8|16).*one-channel (8|16)-bit
depth of 8 bits | depth-16: <5>\.(png|tiff) is an image of 1 channel of uint8
depth of 16 bits | params: <5>\.tiff is an image of 1 channel of uint16
depth missing for a frame
  paired, by-order: 11 images and 10 depth files; frame 3 has only one of the two.*for every image
  rotatecolon: depth_train: 10 of 11 frames have a depth file; frame 3 has none.*for every frame
  nerfstudio: no file \S*depth/frame_00004\.png\. .* of frame images/frame_00004\.png in \S*transforms\.json
  reim-nerf: names \S*distmaps/0003_color\.png, which does not exist
no depth and no points
  c3vd, c3vd-raw, c3vd-v2, tum: neither depth files nor points3D\.ply.*points3D\.ply \(world of the poses\)
an empty folder | all: (holds nothing|holds no COLMAP model|no file .*transforms.json).*Expected
no images | all: (holds nothing|holds 0000_depth|have an image|does not exist).*Expected
an image that is gone
  paired: has 10 images, numbers 0 to 10, but none is 3.*without gaps
  rotatecolon: train_views: 10 of 11 frames have an image; frame 3 has none
  both-colmap: images: 10 of 11 frames have an image; 0003\.png has none
  nerfstudio: transforms\.json: 10 of 11 frames have an image in .*; images/frame_00004\.png has none
  by-order: <poses> has 11 poses for 10 images
  reim-nerf: names \S*images/0003_color\.png, which does not exist
two images of one number | c3vd, c3vd-raw-old, c3vd-v2, c3vd-endogslam, by-order: have the same number
numbers from one on | c3vd, c3vd-v2: numbers 1 to 11, but none is 0
no pose file
  c3vd, c3vd-raw, c3vd-v2: has images but no <poses>
  c3vd-endogslam: no pose.txt
  tum: has images but no groundtruth\.txt or poses\.txt
  reim-nerf: Add transforms_train\.json
fewer poses than images | matrices, by-order: <poses> has 10 poses for 11 images.*a pose for every image
a shorter result | params: params\.npz has [89] poses for 11 images.*Expected 11
more poses than images | matrices, by-order: <poses> has 12 poses for 11 images.*a pose for every image
more frames than images
  json: (<poses> names \S*images/99|11 of 12 frames have an image.*99 has none).*Expected
no poses
  matrices, tum, colmap-text: <poses> holds no poses.*Expected
  json: <poses> is not JSON.*Expected
no frames | json: <poses> has no frames
poses cut short
  matrices, tum: <poses>, line \d+: '.*'.*\d+ finite numbers
  json: <poses> is not JSON: .* line \d+.*Expected
  colmap-text: images\.txt, line \d+: .*Expected X Y POINT3D_ID of each point
  colmap: images\.bin \(\d+ bytes\) is damaged or cut short
poses of something else | matrices, tum, json, colmap-text: cannot read \S*<poses>.*Expected
poses of another format | tum: <poses>, line 1: '1,0,0,0
a result of something else | params: cannot read \S*params\.npz.*written by EndoGSLAM
a number that is none
  matrices: <poses>, line 4: 'nan,.*16 finite numbers
  json: <poses>, frame 1 \(.*\): transform_matrix.*rows of 4 finite numbers
  tum: <poses>, line \d+: '.*8 finite numbers
  colmap-text: images\.txt, line \d+: '4 nan.*all finite
  colmap: images\.bin, image \d+ .*its pose is nan
a result of no numbers | params: params\.npz: cam_trans holds numbers that are not finite
no matrix | json: <poses>, frame 1 \(.*\): transform_matrix
a rotation that is none
  matrices: <poses>, line 4: not a rigid transform \(R\^T R is 3.*within 0\.001
  json: <poses>, frame 1 \(.*\): not a rigid transform \(R\^T R is 3.*within 0\.001
  tum, colmap-text: <poses>, line \d+: a quaternion of length 2.*length 1
  colmap: images\.bin, image 4 \(0003\.png\): a quaternion of length 2.*length 1
a quaternion of length 0 | tum, colmap-text: line \d+: the quaternion .* is not a rotation
a result of no rotation
  params: params\.npz, cam_unnorm_rots, frame 3: the quaternion \(0, 0, 0, 0\) is not a rotation
a left-handed pose
  matrices: <poses>, line 4: a left-handed transform \(det R = -1\).*x right, y down, z forward
  json: <poses>, frame 1 \(.*\): a left-handed transform.*right-handed
a left-handed result | params: params\.npz, gt_w2c_all_frames, frame 3: a left-handed transform.*right-handed
intrinsics of another resolution
  camera.json, nerfstudio, colmap: \.png is 40 x 32, but \S*<size> says 80 x 64
  endomapper: 0000\.png is 40 x 32, but \S*calibration\.xml says 80 x 32
  reim-nerf: rgb_mask\.png is 40 x 32.*80 x 64
  c3vd-endogslam: params\.npz: the principal point .* is \d\d % of the image.*org_width
  c3vd-v2: camera_intrinsics\.txt is ambiguous or implausible: a centre \(338\.739, 543\.058\) far
  rotatecolon: transforms\.json: camera_angle_x is 80.*radians
no camera file
  c3vd: has images but no camera\.json
  tum: but no camera\.json, intrinsics\.txt, cameras\.txt or calibration
a camera cut short
  endomapper: calibration\.xml is not XML: .*line \d+.*Restore
  camera.json: camera\.json is not JSON: .* line.*JSON object
  c3vd-v2: camera_intrinsics\.txt is ambiguous or implausible: no a3, a4
  colmap: cameras\.bin \(\d+ bytes\) is damaged or cut short
a crop | c3vd-raw, c3vd-v2: <0>\.png is 30 x 30.*undistorted layout
another file cut short
  colmap: points3D\.bin \(\d+ bytes\) is damaged or cut short
  rotatecolon: init_point_cloud\.ply \(\d+ bytes\) cannot be read as PLY
  reim-nerf: rgb_mask\.png \(\d+ bytes\) cannot be decoded
  c3vd: rotation/camera_pose\.txt, line \d: '
  c3vd-v2: rotation/rgb/0000\.png \(\d+ bytes\) cannot be decoded
  c3vd-endogslam: rotation/pose\.txt, line \d: '
a model without points | colmap-text: points3D\.txt has 97 points, but not \d+
a model without images | colmap: images\.bin holds no poses.*at least one registered image
no folder of images | colmap-text: no folder \S*images.*the images that the model was made from
no depth scale | tum: their number of steps per unit.*5000 steps per metre.*depth_scale=5000
"""

_CLOUD = "../../C3VD_endogslam_optimized/phantom/point_cloud/iteration_30000/point_cloud"
#: Faults of one layout: by kind, the damage and the pattern of the message.
OWN: dict[str, list[tuple[Spoil, str]]] = {
    "c3vd": [
        (write("camera.json", "[]"), r"camera\.json: fx is None"),
        (change_json("camera.json", cy=None), r"camera\.json: cy is None"),
        (change_json("camera.json", fx="wide"), r"camera\.json: .*'wide'"),
        (change_json("camera.json", fy=0), r"camera\.json: .*above 0"),
        (change_json("camera.json", w=64.5), "whole pixels"),
        (renumber("images/*.png", change=lambda number: f"frame{number}"), "images holds frame0_color.png"),
        (
            lambda folder: copy("images/*.png", "x")(folder).rename(folder / "0000_color.png"),
            r"holds both 0000_color\.png and images/",
        ),
        (remove("images/*.png", 10), "10 images and 11 depth files; frame 10"),
        (copy("rotation/seen/*.png", "0007_seen.png"), r"0007_seen.png, but there are 2 frames"),
        (remove("rotation/camera.json"), r"rotation has images but no camera\.json"),
    ],
    "c3vd-endogslam": [
        (
            change_matrices(lambda matrices: matrices[[*range(1, 11), 0]]),
            r"params\.npz: the true pose of image \d+ is .* mm and .* degrees from that of .*pose\.txt",
        ),
        (change_npz("params.npz", lambda arrays: arrays.pop("means3D")), "no means3D"),
        (change_npz("params.npz", lambda arrays: arrays.pop("org_width")), "no org_width"),
        (
            change_npz("params.npz", lambda arrays: arrays.update(org_width=np.array(800), org_height=np.array(540))),
            r"0000_color\.png is 40 x 32, but .*params\.npz is for 800 x 540",
        ),
        (
            remove("params.npz"),
            r"data has no params.npz.*params_file=FILE`, or `datamanager.poses=ground-truth`",
        ),
        (
            lambda folder: [shutil.rmtree(folder / "rotation"), remove("pose.txt")(folder)],
            "Put the sequence's pose.txt of C3VD's release there",
        ),
        (remove("rotation/pose.txt"), "rotation has images, but it has no pose.txt"),
    ],
    "pr-endo": [
        (cut(f"{_CLOUD}.ply"), r"point_cloud\.ply \(\d+ bytes\) cannot be read as PLY"),
        (
            write(
                f"{_CLOUD}.ply",
                "ply\nformat ascii 1.0\nelement vertex 1\nproperty float x\nproperty float y\nproperty float z\n"
                "end_header\n1 2 3\n",
            ),
            "vertices have x, y, z, but no f_dc_0, f_dc_1, f_dc_2",
        ),
    ],
    "rotatecolon": [
        (write("transforms.json", "{}"), r"transforms\.json has no frames"),
        (change_json("transforms.json", camera_angle_x=None), "camera_angle_x is None"),
        (change_json("transforms_test.json", camera_angle_x=80.0), r"transforms_test\.json: camera_angle_x is 80.0"),
        (remove("test_views_1/*.png", 1), r"test_views_1: 1 of 2 frames have an image; frame 1 has none"),
        (frame(2, "transforms.json", file_path="r_2"), "file_path 'r_2'"),
        (frame(2, "transforms.json", file_path="0001"), "frame 1 is repeated"),
        (
            lambda folder: (folder / "test_views_1").rename(folder / "test_views_2"),
            r"transforms_test.json but no folder test_views_1.*datamanager.test_folder=",
        ),
        (
            lambda folder: change_exr(
                files(folder, "depth_train/*")[4],
                lambda name, pixels: (name.replace("ViewLayer.Depth", "View Layer.Depth"), pixels),
            ),
            r"0004\.exr has the channels View Layer\.Depth\.Z, .*R.*a channel ViewLayer\.Depth\.Z.*depth_channel",
        ),
        *((cut("depth_train/*.exr", 0, share), r"0000\.exr \(\d+ bytes\) cannot be decoded") for share in (0.0, 0.98)),
        (
            lambda folder: [remove("init_point_cloud.ply")(folder), remove("depth_train/*")(folder)],
            "neither depth files nor",
        ),
    ],
    "rgbd": [
        (lambda folder: shutil.rmtree(folder / "rgb"), r"data holds camera\.json, depth\.txt, depth/, .* and 2 more"),
        (lambda folder: (folder / "images").mkdir(), "holds rgb/ and images/"),
        (lambda folder: (folder / "depths").mkdir(), "holds depth/ and depths/"),
        (
            copy("groundtruth.txt", "slam_poses.txt"),
            r"has the trajectories groundtruth\.txt, slam_poses\.txt.*`datamanager\.trajectory=groundtruth\.txt`",
        ),
        (
            lambda folder: (folder / "rgb/1305031102.000000.png").rename(folder / "rgb/0.png"),
            r"rgb/0\.png is not named by a timestamp",
        ),
        (copy("rgb/*.png", "1305031102.000000.jpg"), "1305031102.000000.* have the same timestamp"),
        (
            renumber("depth/*.png", change=lambda seconds: seconds + 100),
            "no depth file within 0.02 of an image that has a pose",
        ),
        (
            change_lines("groundtruth.txt", lambda rows: [row.replace("13050", "13060") for row in rows]),
            r"no pose of .*groundtruth.txt is within 0.02 .*1305031102.000000 .*1306031102",
        ),
        *(
            (with_intrinsics(text), message)
            for text, message in (
                ("61 55 33", r"intrinsics.txt: '61 55 33'"),
                ("61 55 33 x", r"intrinsics.txt: '61 55 33 x'"),
                ("61 2 33 0 55 21 0 0 1", r"without skew"),
                ("0 55 33 21", r"intrinsics.txt: '0 55 33 21'"),
                ("48 47 39 32", r"principal point \(39, 32\) is far from the middle of .*png, 40 x 32"),
                ("12 12 10 8", r"principal point \(10, 8\) is far from the middle"),
            )
        ),
        *((change_json("camera.json", depth_scale=scale), "depth_scale") for scale in (0, -5.0, "5000", True)),
        *(
            (change_json("camera.json", depth_scale=scale), "depth reaches from .* scene units")
            for scale in (1e-7, 1e-320, 1e300)
        ),
    ],
    "rgbd-by-order": [
        (copy("rgb/*.png", "cover.png"), r"cover\.png: no number in its name"),
        (
            lambda folder: (
                [remove("rgb/7.png")(folder), remove("depth/7.png")(folder)]
                and change_lines("groundtruth.txt", lambda rows: [*rows[:5], *rows[6:]])(folder)
            ),
            r"pose 5 has timestamp 6, but image 5 is 5\.png",
        ),
    ],
    "colmap": [
        (
            write("sparse/0/cameras.bin", (1).to_bytes(8, "little") + b"\1\0\0\0\x63\0\0\0"),
            r"cameras\.bin .* is damaged",
        ),
        (change_model(panoramic), "camera 1 is EQUIRECTANGULAR"),
    ],
    "colmap-text": [
        (edit("sparse/0/cameras.txt", " 40 32 ", " 40 32 -"), r"(cameras\.txt|focal)"),
        (write("sparse/0/points3D.txt", "1 hello world\n"), r"points3D\.txt, line 1: '1 hello world'"),
    ],
    "endomapper": [
        (edit("calibration.xml", "_kb4", "_fov"), r"calibration\.xml: the camera model 'calibu_fu_fv_u0_v0_fov'"),
        (
            lambda folder: [
                shutil.copy(folder / "calibration.xml", folder / "other.xml"),
                edit("other.xml", "> 40 <", "> 41 <")(folder),
            ],
            r"calibration\.xml and other\.xml have different cameras",
        ),
        (remove("mask/*.png", 3), r"mask: 10 of 11 frames have a mask; 0003\.png has none"),
    ],
    "nerfstudio": [
        (change_frames("transforms.json", fourth_without("depth_file_path")), "10 of 11 frames have a depth_file_path"),
        *(
            (change_json("transforms.json", **content), message)
            for content, message in (
                ({"camera_model": "PANORAMA"}, "camera_model is PANORAMA"),
                ({"k4": 0.1}, "OPENCV with k4 = 0.1"),
                ({"camera_model": ["PINHOLE"]}, "camera_model is .'PINHOLE'."),
                ({"camera_model": "PINHOLE", "k1": 0.1}, "PINHOLE with k1 = 0.1"),
                ({"camera_model": "OPENCV_FISHEYE", "p1": 0.1}, "OPENCV_FISHEYE with p1 = 0.1"),
                ({"fl_x": None, "fl_y": None}, "neither fl_x nor camera_angle_x"),
                ({"fl_x": None, "fl_y": None, "camera_angle_y": 4.0}, "camera_angle_y is 4"),
                ({"fl_x": -61.0}, "fl_x -61"),
                ({"fl_x": "wide"}, "fl_x is 'wide'"),
                ({"cx": np.nan}, "cx is nan"),
                ({"w": 64.5}, "w = 64.5"),
                ({"h": None}, "h is None"),
                ({"ply_file_path": "gone.ply"}, r"no file .*gone\.ply"),
                ({"depth_unit_scale_factor": 0}, "depth_unit_scale_factor is 0"),
                ({"train_filenames": ["images/frame_0001.png"]}, r"train_filenames names .*Did you mean"),
                ({"train_filenames": "all"}, "train_filenames is not a list"),
                ({"depth_estimated_from": ["images/frame_1.png"]}, r"depth_estimated_from names .*Did you mean"),
                (
                    {f"{part}_filenames": ["images/frame_00001.png"] for part in ("train", "test")},
                    "is in train_filenames and test_filenames",
                ),
                ({"applied_transform": [[2, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0]]}, "applied_transform"),
            )
        ),
    ],
    "reim-nerf": [
        (remove("transforms_true_test.json"), r"has no transforms_true_test\.json.*choose another split"),
        (write("transforms_val.json", "{"), r"transforms_val\.json is not JSON"),
        (frame(1, "*_train.json", file_path=None), r"_train\.json, frame 1: no file_path"),
        (
            change_frame("transforms_test.json", 0, lambda matrix: matrix.__setitem__((0, 3), 0.5)),
            r"_test\.json: pose or distance map of images/0000_color\.png differs",
        ),
        (change_json("*_val.json", scene_scale=0.5), r"_val\.json: scene_scale differs from transforms_train\.json"),
        (
            change_json("transforms_train.json", lambda content: content["frames"].append(content["frames"][0])),
            r"_train\.json: 'images/0000_color\.png' is repeated",
        ),
        *(
            (change_json("transforms_*.json", **{key: value}), message)
            for key, value, message in (
                ("scene_scale", None, r"_train\.json: scene_scale is None"),
                ("scene_scale", 0.0, r"_train\.json: scene_scale is 0"),
                ("distmap_scale", -1.0, r"_train\.json: distmap_scale is -1"),
                ("scene_T", TURNED, r"_train\.json: scene_T is not a translation"),
                ("scene_T", None, r"_train\.json: scene_T is not a translation"),
                ("camera_model", "OPENCV", "camera_model 'OPENCV'.*FISHEYE_OPENCV"),
                ("w", None, r"_train\.json: w is None"),
                ("h", 51.5, r"h = 51\.5"),
                ("fy", 0, r"_train\.json: .*above 0"),
                ("p1", 0.01, r"_train\.json: p1 = 0.01"),
            )
        ),
        (
            change_frames(
                "transforms_*.json",
                lambda index, entry: entry.pop("distmap_path") if "0005" in entry["file_path"] else None,
            ),
            r"10 of 11 frames have a distmap_path; images/0005_color\.png has none",
        ),
        (remove("rgb_mask.png"), r"no file .*rgb_mask\.png.*mask=false"),
        (repaint("rgb_mask.png", 0, half_size), r"rgb_mask\.png is 20 x 16.*40 x 32"),
        (
            repaint("rgb_mask.png", 0, lambda mask: np.dstack([mask, mask // 2, mask])),
            r"rgb_mask\.png is a colour image.*three equal ones",
        ),
    ],
}
REFUSED = expanded(SAID, DAMAGES) | {
    (f"its own, {number}", name): row for name, rows in OWN.items() for number, row in enumerate(rows)
}

#: What may be a fault: the damage, and the pattern of the warning.
DOUBTS: dict[str, Callable[[Kind], Spoil]] = {
    "an image without a pose": lambda k: (
        lambda folder: copy(k.images, re.sub(r"\d+", "00099", files(folder, k.images)[0].name))(folder)
    ),
    "a pose less": lambda k: change_lines(k.poses, lambda rows: rows[:-1]),
    "a depth file less": lambda k: remove(k.depths, 3),
}
WARNED = expanded(
    r"""
an image without a pose
  rotatecolon: transforms\.json: 1 images of train_views have no pose and are left out
  nerfstudio: transforms\.json: 1 images have no pose and are left out: frame_00099\.png
  colmap: images\.bin: 1 images have no pose and are left out: 00099\.png
  reim-nerf: 1 images have no pose and are left out: 00099_color\.png
a pose less | rgbd: of 11 images 1 have no pose and 0 no depth within 0\.02 s
a depth file less | rgbd: of 11 images 0 have no pose and 1 no depth within 0\.02 s
""",
    DOUBTS,
)
