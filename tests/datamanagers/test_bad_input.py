"""What is wrong with a folder is one clear error, or a warning, whatever its layout: never a traceback.

A row of a table spoils one thing in the phantom of a layout (``spoiling``) and says what the message must name: the
file, what was seen in it, and what would have been right.
"""

from __future__ import annotations

import json
import logging
import re
import shutil
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pycolmap
import pytest

from coliags_plugin.checks.data.check import check_scene
from coliags_plugin.config.registry import datamanagers
from coliags_plugin.core.errors import InputError
from coliags_plugin.core.scenes import Scene
from coliags_plugin.datamanagers.recognition import find_format, formats
from tests.datamanagers.spoiling import (
    FRAMES,
    KINDS,
    Kind,
    Spoil,
    change_binary_pose,
    change_frame,
    change_json,
    change_matrices,
    change_npz,
    change_row,
    clear,
    cut,
    drop_last_line,
    files,
    half_size,
    mirror,
    mirror_rows,
    remove,
    rename_channel,
    repaint,
    repeat_last_line,
    spoil_number,
    stretch,
    three_channels,
    unregistered,
    write_all,
)
from tests.phantom.phantom_layouts import in_video_order, true_poses

#: Kinds whose poses are sixteen numbers a line.
MATRICES = ("c3vd", "c3vd-raw", "c3vd-raw-old", "c3vd-v2", "c3vd-endogslam")
#: Kinds whose poses are frames of a JSON file.
FRAMES_OF_JSON = ("rotatecolon", "nerfstudio", "reim-nerf")
TUM = ("rgbd", "rgbd-by-order")
#: EndoGSLAM's result, from the scene's folder.
PARAMS = {"c3vd-endogslam": "params.npz", "pr-endo": "../../C3VD_endogslam_optimized/phantom/params.npz"}
WITH_DEPTH = tuple(name for name, kind in KINDS.items() if kind.depths)

Rows = dict[str, tuple[Spoil, tuple[str, ...]]]


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    return write_all(tmp_path_factory.mktemp("phantoms"))


@pytest.fixture
def copied(made, tmp_path) -> Callable[[str], Path]:
    """A scene of a kind to spoil."""
    return lambda name: Path(shutil.copytree(made[name], tmp_path / "data")) / KINDS[name].scene


def load(folder: Path, name: str) -> Scene:
    manager = datamanagers.get(KINDS[name].format)
    return manager(manager.Settings()).load(folder)


def per_kind(names, row: Callable[[str, Kind], tuple[Spoil, tuple[str, ...]]]) -> Rows:
    return {name: row(name, KINDS[name]) for name in names}


def numbered(name: str, place: int) -> str:
    """What the image of a place is called, as a pattern."""
    if name == "rgbd":
        return f"{1_305_031_102 + place / 30:.6f}"
    return f"frame_{place + 1:05d}" if name == "nerfstudio" else rf"0*{place}(_color|_depth)?"


def said_size(name: str) -> str:
    """The file that says how large images are."""
    said = {
        "c3vd": "camera.json",
        "colmap": "cameras.bin",
        "colmap-text": "cameras.txt",
        "nerfstudio": "transforms.json",
        "rgbd": "camera.json",
        "rgbd-by-order": "camera.json",
        "reim-nerf": "transforms_train.json",
    }
    return said.get(name, rf"{numbered(name, 0)}\.png")


def _doubled(*keys: str) -> Callable[[dict], None]:
    return lambda content: content.update({key: 2 * content[key] for key in keys})


def _double_colmap(size: bool) -> Spoil:
    def spoil(folder: Path) -> None:
        model = pycolmap.Reconstruction(str(folder / "sparse/0"))
        for camera in model.cameras.values():
            if size:
                camera.rescale(2.0)
            else:
                camera.params = 2.0 * camera.params
        model.write_binary(str(folder / "sparse/0"))

    return spoil


def _cut_after_lines(name: str, count: int) -> Spoil:
    return lambda folder: (folder / name).write_text("".join((folder / name).open().readlines()[:count]))


def _rubbish(name: str) -> Spoil:
    return lambda folder: (folder / name).write_bytes(bytes(range(256)))


#: fault -> kind -> how to spoil it, and what the message must hold, in this order.
REFUSED: dict[str, Rows] = {
    "an image of another size": per_kind(
        KINDS,
        lambda name, kind: (
            repaint(kind.images, 4, half_size),
            (rf"{numbered(name, 4)}\.png is 32 x 26, but \S*{said_size(name)} says 64 x 51", "of one size"),
        ),
    ),
    "the first image of another size": per_kind(
        KINDS,
        lambda name, kind: (repaint(kind.images, 0, half_size), (r"(32 x 26.*64 x 51|64 x 51.*32 x 26)",)),
    ),
    "a depth file of another size": per_kind(
        WITH_DEPTH,
        lambda name, kind: (
            repaint(kind.depths, 0, half_size),
            (rf"{numbered(name, 0)}\.(png|tiff|exr) is 32 x 26, but \S*{said_size(name)} says 64 x 51",),
        ),
    ),
    "an image cut short": per_kind(
        KINDS,
        lambda name, kind: (
            cut(kind.images, 4),
            (rf"{numbered(name, 4)}\.png \(\d+ bytes\) cannot be decoded", "a complete image"),
        ),
    ),
    "an empty image": per_kind(
        KINDS,
        lambda name, kind: (cut(kind.images, 4, 0.0), (rf"{numbered(name, 4)}\.png \(0 bytes\) cannot be decoded",)),
    ),
    "a depth file cut short": per_kind(
        WITH_DEPTH,
        lambda name, kind: (
            cut(kind.depths, 5),
            (rf"{numbered(name, 5)}\.(png|tiff|exr) \(\d+ bytes\) cannot be decoded", "complete"),
        ),
    ),
    "a depth file of three channels": per_kind(
        [name for name in WITH_DEPTH if name != "rotatecolon"],
        lambda name, kind: (
            repaint(kind.depths, 5, three_channels),
            (rf"{numbered(name, 5)}\.(png|tiff) is an image of 3 channels of uint(8|16)", r"one-channel (8|16)-bit"),
        ),
    ),
    "depth that is missing for a frame": {
        **per_kind(
            ("c3vd", "c3vd-raw", "c3vd-raw-old", "c3vd-v2", "c3vd-endogslam", "pr-endo", "rgbd-by-order"),
            lambda name, kind: (
                remove(kind.depths, 3),
                ("11 images and 10 depth files; frame 3 has only one of the two", "for every image"),
            ),
        ),
        "rotatecolon": (
            remove("depth_train/*.exr", 3),
            ("depth_train has 10 depth files for 11 frames; frame 3 has none", "for every image"),
        ),
        "nerfstudio": (
            remove("depth/*.png", 3),
            (r"transforms\.json, frame images/frame_00004\.png: no file \S*depth/frame_00004\.png",),
        ),
        "reim-nerf": (remove("distmaps/*.png", 3), (r"names \S*distmaps/0003_color\.png, which does not exist",)),
    },
    "no depth and no points": per_kind(
        ("c3vd", "c3vd-raw", "c3vd-v2", "rgbd"),
        lambda name, kind: (
            remove(kind.depths),
            (r"neither depth files nor points3D\.ply", r"points3D\.ply \(world of the poses\)"),
        ),
    ),
    "an empty folder": per_kind(
        KINDS,
        lambda name, kind: (clear, ("(holds nothing|holds no COLMAP model|no file .*transforms.json)", "Expected")),
    ),
    "no images": per_kind(
        KINDS,
        lambda name, kind: (
            remove(kind.images),
            ("(holds nothing|holds 0000_depth|have no image|are not in|has no image|does not exist)", "Expected"),
        ),
    ),
    "an image that is gone": {
        **per_kind(
            ("c3vd", "c3vd-raw", "c3vd-raw-old", "c3vd-v2", "c3vd-endogslam", "pr-endo"),
            lambda name, kind: (
                remove(kind.images, 3),
                ("has 10 images, numbers 0 to 10, but none is 3", "without gaps"),
            ),
        ),
        "rotatecolon": (remove("train_views/*.png", 3), (r"transforms\.json: frame 3 has no image \S*0003\.png",)),
        **per_kind(
            ("colmap", "colmap-text"),
            lambda name, kind: (
                remove(kind.images, 3),
                (r"1 of the 11 images of \S*sparse/0 are not in \S*images: 0003\.png",),
            ),
        ),
        "nerfstudio": (
            remove("images/*.png", 3),
            (r"transforms\.json: 1 of 11 frames have no image in .*images/frame_00004\.png",),
        ),
        "rgbd-by-order": (remove("rgb/*.png", 3), (r"groundtruth\.txt has 11 poses for 10 images",)),
        "reim-nerf": (remove("images/*.png", 3), (r"names \S*images/0003_color\.png, which does not exist",)),
    },
    "fewer poses than images": {
        **per_kind(
            (*MATRICES, "rgbd-by-order"),
            lambda name, kind: (
                drop_last_line(kind.poses),
                (rf"{kind.poses} has 10 poses for 11 images", "a pose for every image"),
            ),
        ),
        **per_kind(
            PARAMS,
            lambda name, kind: (
                change_npz(PARAMS[name], lambda arrays: _shorten(arrays, 2)),
                (r"params\.npz has 8 poses for 11 images|params\.npz has 9 poses for 11 images", "Expected 11"),
            ),
        ),
    },
    "more poses than images": {
        **per_kind(
            (*MATRICES, "rgbd-by-order"),
            lambda name, kind: (
                repeat_last_line(kind.poses),
                (rf"{kind.poses} has 12 poses for 11 images", "a pose for every image"),
            ),
        ),
        **per_kind(
            FRAMES_OF_JSON,
            lambda name, kind: (
                change_json(
                    kind.poses,
                    lambda content: content["frames"].append({**content["frames"][-1], "file_path": "images/99"}),
                ),
                (
                    rf"{kind.poses}(: frame 99 has no image| names \S*images/99|: 1 of 12 frames have no image)",
                    "Expected",
                ),
            ),
        ),
    },
    "no poses": {
        **per_kind(
            (*MATRICES, *TUM, "colmap-text"),
            lambda name, kind: (cut(kind.poses, 0, 0.0), (rf"{kind.poses} holds no poses", "Expected")),
        ),
        **per_kind(
            FRAMES_OF_JSON,
            lambda name, kind: (cut(kind.poses, 0, 0.0), (rf"{kind.poses} is not JSON", "Expected")),
        ),
    },
    "a pose file cut short": {
        **per_kind(
            (*MATRICES, *TUM),
            lambda name, kind: (cut(kind.poses), (rf"{kind.poses}, line \d+: '.*'", r"\d+ finite numbers")),
        ),
        **per_kind(
            FRAMES_OF_JSON,
            lambda name, kind: (cut(kind.poses), (rf"{kind.poses} is not JSON: .* line \d+", "Expected")),
        ),
        "colmap-text": (cut("sparse/0/images.txt"), (r"sparse/0 cannot be read", r"images\.txt", "complete")),
        "colmap": (cut("sparse/0/images.bin"), (r"images\.bin \(\d+ bytes\) is damaged or cut short",)),
        **per_kind(
            PARAMS,
            lambda name, kind: (
                lambda folder: (folder / PARAMS[name]).write_bytes((folder / PARAMS[name]).read_bytes()[:4000]),
                (r"cannot read \S*params\.npz", "written by EndoGSLAM"),
            ),
        ),
    },
    "a pose file of something else": per_kind(
        (*MATRICES, *TUM, *FRAMES_OF_JSON, "colmap-text"),
        lambda name, kind: (_rubbish(kind.poses), (rf"cannot read \S*{kind.poses}", "Expected")),
    ),
    "a number that is none": {
        **per_kind(
            MATRICES,
            lambda name, kind: (
                change_matrices(kind.poses, lambda matrices: spoil_number(matrices[3])),
                (rf"{kind.poses}, line 4: 'nan,", "16 finite numbers"),
            ),
        ),
        **per_kind(
            FRAMES_OF_JSON,
            lambda name, kind: (
                change_frame(kind.poses, 1, spoil_number),
                (rf"{kind.poses}, frame 1 \(.*\): transform_matrix", "rows of 4 finite numbers"),
            ),
        ),
        **per_kind(
            TUM,
            lambda name, kind: (
                change_row(kind.poses, 3, 4, lambda quat: quat * np.nan),
                (rf"{kind.poses}, line \d+: '", "8 finite numbers"),
            ),
        ),
        "colmap-text": (
            change_row("sparse/0/images.txt", 6, 1, lambda quat: quat * np.nan),
            (r"images\.txt, line \d+: '4 nan", "all numbers finite"),
        ),
        "colmap": (
            change_binary_pose(3, lambda values: values * np.nan),
            (r"images\.bin, image \d+ ", "its pose is nan"),
        ),
        **per_kind(
            PARAMS,
            lambda name, kind: (
                change_npz(PARAMS[name], lambda arrays: arrays.update(cam_trans=arrays["cam_trans"] * np.nan)),
                (r"params\.npz: cam_trans holds numbers that are not finite",),
            ),
        ),
    },
    "a rotation that is none": {
        **per_kind(
            MATRICES,
            lambda name, kind: (
                change_matrices(kind.poses, lambda matrices: stretch(matrices[3])),
                (rf"{kind.poses}, line 4: not a rigid transform \(R\^T R is 3", r"within 0\.001"),
            ),
        ),
        **per_kind(
            FRAMES_OF_JSON,
            lambda name, kind: (
                change_frame(kind.poses, 1, stretch),
                (rf"{kind.poses}, frame 1 \(.*\): not a rigid transform \(R\^T R is 3", r"within 0\.001"),
            ),
        ),
        **per_kind(
            TUM,
            lambda name, kind: (
                change_row(kind.poses, 3, 4, lambda quat: 2.0 * quat),
                (rf"{kind.poses}, line \d+: a quaternion of length 2", "length 1"),
            ),
        ),
        "colmap-text": (
            change_row("sparse/0/images.txt", 6, 1, lambda quat: 2.0 * quat),
            (r"images\.txt, line \d+: a quaternion of length 2", "length 1"),
        ),
        "colmap": (
            change_binary_pose(3, lambda values: 2.0 * values),
            (r"images\.bin, image 4 \(0003\.png\): a quaternion of length 2", "length 1"),
        ),
        **per_kind(
            PARAMS,
            lambda name, kind: (
                change_npz(PARAMS[name], lambda arrays: arrays["cam_unnorm_rots"][..., 3].fill(0.0)),
                (r"params\.npz, cam_unnorm_rots, frame 3: the quaternion \(0, 0, 0, 0\) is not a rotation",),
            ),
        ),
    },
    "a left-handed pose": {
        **per_kind(
            MATRICES,
            lambda name, kind: (
                change_matrices(
                    kind.poses, lambda matrices: (mirror if name == "c3vd-raw-old" else mirror_rows)(matrices[3])
                ),
                (rf"{kind.poses}, line 4: a left-handed transform \(det R = -1\)", "x right, y down, z forward"),
            ),
        ),
        **per_kind(
            FRAMES_OF_JSON,
            lambda name, kind: (
                change_frame(kind.poses, 1, mirror),
                (rf"{kind.poses}, frame 1 \(.*\): a left-handed transform", "right-handed"),
            ),
        ),
        **per_kind(
            PARAMS,
            lambda name, kind: (
                change_npz(PARAMS[name], lambda arrays: mirror(arrays["gt_w2c_all_frames"][3])),
                (r"params\.npz, gt_w2c_all_frames, frame 3: a left-handed transform", "right-handed"),
            ),
        ),
    },
    "intrinsics of another resolution": {
        "c3vd": (
            change_json("camera.json", _doubled("fx", "fy", "cx", "cy", "w", "h")),
            (r"0000_color\.png is 64 x 51, but \S*camera\.json says 128 x 102",),
        ),
        **per_kind(
            TUM,
            lambda name, kind: (
                change_json("camera.json", _doubled("fx", "fy", "cx", "cy", "w", "h")),
                (r"\.png is 64 x 51, but \S*camera\.json says 128 x 102",),
            ),
        ),
        "nerfstudio": (
            change_json("transforms.json", _doubled("fl_x", "fl_y", "cx", "cy", "w", "h")),
            (r"frame_00001\.png is 64 x 51, but \S*transforms\.json says 128 x 102",),
        ),
        "reim-nerf": (
            change_json("transforms_*.json", _doubled("fx", "fy", "cx", "cy", "w", "h")),
            (r"rgb_mask\.png is 64 x 51", "128 x 102"),
        ),
        "colmap": (_double_colmap(size=True), (r"0000\.png is 64 x 51, but \S*cameras\.bin says 128 x 102",)),
        **per_kind(
            PARAMS,
            lambda name, kind: (
                change_npz(
                    PARAMS[name], lambda arrays: arrays.update(intrinsics=arrays["intrinsics"] * [[2], [2], [1]])
                ),
                (r"params\.npz: the principal point .* is 5\d % of the image", "org_width"),
            ),
        ),
        "c3vd-v2": (
            lambda folder: (folder / "camera_intrinsics.txt").write_text(
                (folder / "camera_intrinsics.txt").read_text().replace("cx = 677", "cx = 338")
            ),
            (r"camera_intrinsics\.txt is ambiguous or implausible: a centre \(338\.739, 543\.058\) far",),
        ),
        "rotatecolon": (
            change_json("transforms.json", lambda content: content.update(camera_angle_x=80.0)),
            (r"transforms\.json: camera_angle_x is 80", "radians"),
        ),
    },
    "a camera file cut short": {
        **per_kind(
            ("c3vd", *TUM),
            lambda name, kind: (cut("camera.json"), (r"camera\.json is not JSON: .* line", "JSON object")),
        ),
        "c3vd-v2": (cut("camera_intrinsics.txt"), (r"camera_intrinsics\.txt is ambiguous or implausible: no a3, a4",)),
        "colmap": (cut("sparse/0/cameras.bin"), (r"cameras\.bin \(\d+ bytes\) is damaged or cut short",)),
        "colmap-text": (cut("sparse/0/cameras.txt", 0, 0.9), (r"cameras\.txt, line 4: '1 PINHOLE 64 51",)),
    },
    "another file of the layout cut short": {
        "colmap": (cut("sparse/0/points3D.bin"), (r"points3D\.bin \(\d+ bytes\) is damaged or cut short",)),
        "colmap-text": (
            _cut_after_lines("sparse/0/points3D.txt", 100),
            (r"points3D\.txt has 97 points, but not \d+",),
        ),
        "rotatecolon": (cut("init_point_cloud.ply"), (r"init_point_cloud\.ply says it has \d+ vertices, but holds",)),
        "reim-nerf": (cut("rgb_mask.png"), (r"rgb_mask\.png \(\d+ bytes\) cannot be decoded",)),
        "pr-endo": (
            cut("../../C3VD_endogslam_optimized/phantom/point_cloud/iteration_30000/point_cloud.ply"),
            (r"point_cloud\.ply says it has 20000 vertices, but holds \d+",),
        ),
        "c3vd": (cut("rotation/camera_pose.txt"), (r"rotation/camera_pose\.txt, line \d: '",)),
        "c3vd-raw": (cut("rotation/*_depth.tiff"), (r"rotation/0000_depth\.tiff \(\d+ bytes\) cannot be decoded",)),
        "c3vd-v2": (cut("rotation/rgb/*.png"), (r"rotation/rgb/0000\.png \(\d+ bytes\) cannot be decoded",)),
        "c3vd-endogslam": (cut("rotation/pose.txt"), (r"rotation/pose\.txt, line \d: '",)),
    },
    "a model without images": {
        "colmap": (unregistered, (r"images\.bin holds no poses", "at least one registered image")),
        "colmap-text": (
            lambda folder: shutil.rmtree(folder / "images"),
            (r"no folder \S*images", "the images that the model was made from"),
        ),
    },
    "another channel than expected": {
        "rotatecolon": (
            rename_channel("depth_train/*.exr", 4, "ViewLayer.Depth.Z", "View Layer.Depth.Z"),
            (
                r"0004\.exr has the channels View Layer\.Depth\.Z, .*R",
                r"a channel ViewLayer\.Depth\.Z",
                "depth_channel",
            ),
        ),
    },
    "a depth scale that nobody says": per_kind(
        TUM,
        lambda name, kind: (
            change_json("camera.json", lambda content: content.pop("depth_scale")),
            ("their number of steps per unit", "5000 steps per metre", "depth_scale=5000"),
        ),
    ),
}


def _shorten(arrays: dict[str, np.ndarray], by: int) -> None:
    for key in ("cam_unnorm_rots", "cam_trans"):
        arrays[key] = arrays[key][..., :-by]
    arrays["gt_w2c_all_frames"] = arrays["gt_w2c_all_frames"][:-by]


@pytest.mark.parametrize(("fault", "name"), [(fault, name) for fault, rows in REFUSED.items() for name in rows])
def test_one_clear_error(copied, fault, name):
    spoil, fragments = REFUSED[fault][name]
    folder = copied(name)
    spoil(folder)
    # Whatever is in the folder, looking which format it is does not fail.
    datamanagers.get(KINDS[name].format).recognise(folder)
    with pytest.raises(InputError) as caught:
        load(folder, name)
    message = str(caught.value)
    assert re.search(".*".join(f"(?:{fragment})" for fragment in fragments), message), message
    assert caught.value.expected, message
    assert "\n" not in message


def test_every_fault_meets_every_layout_it_can_befall():
    """The table is complete: of the faults that any scene can have, no layout is left out."""
    for fault in ("an image of another size", "an image cut short", "an empty folder", "no images"):
        assert set(REFUSED[fault]) == set(KINDS), fault
    for fault in ("a number that is none", "a rotation that is none", "a pose file cut short"):
        assert set(REFUSED[fault]) == set(KINDS), fault
    for fault in ("a depth file cut short", "a depth file of another size"):
        assert set(REFUSED[fault]) == set(WITH_DEPTH), fault
    # By time, there may be more poses than images, and what has no depth is left out with a warning.
    assert set(REFUSED["an image that is gone"]) == set(KINDS) - {"rgbd"}
    assert set(REFUSED["depth that is missing for a frame"]) == set(WITH_DEPTH) - {"rgbd"}
    assert {KINDS[name].format for name in KINDS} == set(formats())


# What is worth a warning and no more

_DOUBLE_K = r"the principal point is (4\d|5\d)% of the image \(64 x 51\) from its middle.*another resolution"

WARNED: dict[str, Rows] = {
    "intrinsics of another resolution that say they are of this one": {
        "c3vd": (change_json("camera.json", _doubled("fx", "fy", "cx", "cy")), (rf"camera\.json: {_DOUBLE_K}",)),
        "rgbd": (change_json("camera.json", _doubled("fx", "fy", "cx", "cy")), (rf"camera\.json: {_DOUBLE_K}",)),
        "colmap": (_double_colmap(size=False), (rf"cameras\.bin: {_DOUBLE_K}",)),
        "nerfstudio": (
            change_json("transforms.json", _doubled("fl_x", "fl_y", "cx", "cy")),
            (rf"transforms\.json: {_DOUBLE_K}",),
        ),
        "reim-nerf": (
            change_json("transforms_*.json", _doubled("fx", "fy", "cx", "cy")),
            (rf"transforms_train\.json: {_DOUBLE_K}",),
        ),
    },
    "images without a pose": {
        "rotatecolon": (
            change_json("transforms.json", lambda content: content["frames"].pop()),
            (r"transforms\.json: 1 images of train_views have no pose and are left out",),
        ),
        "nerfstudio": (
            change_json("transforms.json", lambda content: content["frames"].pop()),
            (r"transforms\.json: 1 images have no pose and are left out: frame_00011\.png",),
        ),
        "colmap": (
            lambda folder: shutil.copy(folder / "images/0000.png", folder / "images/0011.png"),
            (r"images\.bin: 1 images have no pose and are left out: 0011\.png",),
        ),
        "reim-nerf": (
            lambda folder: shutil.copy(folder / "images/0000_color.png", folder / "images/0011_color.png"),
            (r"1 images have no pose and are left out: 0011_color\.png",),
        ),
        "rgbd": (drop_last_line("groundtruth.txt"), (r"of 11 images 1 have no pose and 0 no depth within 0\.02 s",)),
    },
    "depth that is missing for a frame": {
        "rgbd": (remove("depth/*.png", 3), (r"of 11 images 0 have no pose and 1 no depth within 0\.02 s",)),
    },
}


@pytest.mark.parametrize(("fault", "name"), [(fault, name) for fault, rows in WARNED.items() for name in rows])
def test_one_clear_warning(copied, caplog, fault, name):
    spoil, (message,) = WARNED[fault][name]
    folder = copied(name)
    spoil(folder)
    with caplog.at_level(logging.WARNING):
        load(folder, name)
    (found,) = [record.getMessage() for record in caplog.records if re.search(message, record.getMessage())]
    assert str(folder) in found


@pytest.mark.parametrize("name", KINDS)
def test_nothing_is_wrong_with_an_unspoilt_folder(made, caplog, name):
    folder = made[name] / KINDS[name].scene
    with caplog.at_level(logging.WARNING):
        scene = load(folder, name)
    assert caplog.records == []
    assert find_format(folder) == KINDS[name].format
    test_frames = scene.test_sets["rotation" if name == "rotatecolon" else "test"] if name != "rotatecolon" else []
    assert len(scene.train) + len(test_frames) == FRAMES


# What data check is for


def _shallow_exr(folder: Path) -> None:
    for place in range(FRAMES):
        repaint("depth_train/*.exr", place, lambda pixels: pixels / 1000.0)(folder)


METRES = {
    "rgbd": change_json("camera.json", lambda content: content.update(depth_scale=1000.0 * content["depth_scale"])),
    "nerfstudio": change_json(
        "transforms.json",
        lambda content: content.update(depth_unit_scale_factor=content["depth_unit_scale_factor"] / 1000.0),
    ),
    "rotatecolon": _shallow_exr,
}


@pytest.mark.parametrize("name", METRES)
def test_depth_in_metres_is_suspect(copied, name):
    folder = copied(name)
    METRES[name](folder)
    found = {finding.what: finding for finding in check_scene(load(folder, name)).findings}
    assert "mm" in found["depth looks like metres"].do
    assert "depth and poses are in different units" in found


# What is no fault


def _unpad(*patterns: str) -> Spoil:
    def spoil(folder: Path) -> None:
        for pattern in patterns:
            for path in files(folder, pattern):
                path.rename(path.with_name(re.sub(r"0*(\d+)", r"\1", path.name, count=1)))

    return spoil


def _unpad_json(pattern: str) -> Spoil:
    def spoil(content: dict) -> None:
        for frame in content["frames"]:
            for key in ("file_path", "depth_file_path", "distmap_path"):
                if key in frame:
                    frame[key] = re.sub(r"0*(\d+)", r"\1", frame[key], count=1)

    return change_json(pattern, spoil)


def _unpad_colmap(folder: Path) -> None:
    _unpad("images/*.png")(folder)
    path = folder / "sparse/0/images.txt"
    path.write_text(re.sub(r"\b0*(\d+)\.png", r"\1.png", path.read_text()))


UNPADDED = {
    **{name: _unpad(KINDS[name].images, KINDS[name].depths) for name in (*MATRICES, "pr-endo", "rotatecolon")},
    # In TUM's form by order, names of the fixture are unpadded as they are.
    "rgbd-by-order": _unpad(),
    "colmap-text": _unpad_colmap,
    "nerfstudio": lambda folder: [
        _unpad("images/*.png", "depth/*.png")(folder),
        _unpad_json("transforms.json")(folder),
    ],
    "reim-nerf": lambda folder: [
        _unpad("images/*.png", "distmaps/*.png")(folder),
        _unpad_json("transforms_*.json")(folder),
    ],
}


@pytest.mark.parametrize("name", UNPADDED)
def test_names_without_leading_zeros_come_in_the_order_of_their_numbers(copied, made, name):
    folder = copied(name)
    UNPADDED[name](folder)
    images = files(folder, KINDS[name].images)
    assert sorted(images) != images, "the names' own order is another one"
    frames, expected = in_video_order(load(folder, name)), in_video_order(load(made[name] / KINDS[name].scene, name))
    assert [frame.index for frame in frames] == [frame.index for frame in expected]
    for frame, same in zip(frames, expected, strict=True):
        assert (frame.image == same.image).all()
        assert (frame.camera.camera_to_world == same.camera.camera_to_world).all()
        assert (frame.depth is None) == (same.depth is None)
        assert frame.depth is None or frame.depth.nan_to_num().equal(same.depth.nan_to_num())


def test_an_image_less_than_there_are_poses_is_no_fault_by_time(copied, made):
    folder = copied("rgbd")
    remove("rgb/*.png", 3)(folder)
    found = in_video_order(load(folder, "rgbd"))
    expected = in_video_order(load(made["rgbd"], "rgbd"))
    for frame, same in zip(found, [*expected[:3], *expected[4:]], strict=True):
        assert frame.name == same.name
        assert (frame.camera.camera_to_world == same.camera.camera_to_world).all()
        assert (frame.depth.nan_to_num() == same.depth.nan_to_num()).all()
        # Seen masks are numbered by image and would now be those of others.
        assert frame.seen is None


@pytest.mark.parametrize("name", PARAMS)
def test_quaternions_that_may_be_of_any_length(copied, name):
    """EndoGSLAM optimises quaternions without normalising them, and says so in their name."""
    folder = copied(name)
    before = in_video_order(load(folder, name))
    change_npz(PARAMS[name], lambda arrays: arrays.update(cam_unnorm_rots=3.0 * arrays["cam_unnorm_rots"]))(folder)
    after = in_video_order(load(folder, name))
    for one, other in zip(before, after, strict=True):
        np.testing.assert_allclose(one.camera.camera_to_world, other.camera.camera_to_world, atol=1e-5)


def test_both_reading_orders_of_c3vds_poses_give_the_true_ones(made):
    for name, order in (("c3vd-raw", "column-major"), ("c3vd-raw-old", "row-major")):
        scene = load(made[name], name)
        assert scene.provenance["pose_convention"]["order"] == order
        found = np.stack([frame.camera.camera_to_world.numpy() for frame in in_video_order(scene)])
        np.testing.assert_allclose(found, true_poses(made[name]), atol=1e-4)


# What the pages say is refused

PAGES = Path(__file__).parents[2] / "docs/layouts"
_MODEL_OF_NOTHING = change_json("transforms.json", lambda content: content.update(camera_model="PANORAMA"))


def _with_confidence(spoil: Callable[[dict], object] = lambda content: None, dtype: str = "uint8") -> Spoil:
    """Every frame gets a confidence, then the content is spoilt."""

    def change(folder: Path) -> None:
        content = json.loads((folder / "transforms.json").read_text())
        for frame in content["frames"]:
            frame["confidence_file_path"] = frame["depth_file_path"].replace("depth/", "confidence/")
            file = folder / frame["confidence_file_path"]
            file.parent.mkdir(exist_ok=True)
            depth = cv2.imread(str(folder / frame["depth_file_path"]), cv2.IMREAD_UNCHANGED)
            cv2.imwrite(str(file), np.zeros(depth.shape, dtype if "00003" in file.name else "uint8"))
        spoil(content)
        (folder / "transforms.json").write_text(json.dumps(content))

    return change


#: By page, in the order of its table: the kind, and how to spoil it, or the fault above that does.
TOLD: dict[str, list[tuple[str, str | Spoil]]] = {
    "colmap": [
        ("colmap", "an empty folder"),
        ("colmap", "a model without images"),
        ("colmap", "another file of the layout cut short"),
        ("colmap-text", "another file of the layout cut short"),
        ("colmap-text", "a rotation that is none"),
        ("colmap-text", "a model without images"),
        ("colmap", "an image that is gone"),
        ("colmap", "an image of another size"),
        ("colmap", "an image cut short"),
    ],
    "nerfstudio": [
        ("nerfstudio", "an empty folder"),
        ("nerfstudio", "a pose file cut short"),
        ("nerfstudio", change_json("transforms.json", lambda content: content["frames"].clear())),
        ("nerfstudio", "an image that is gone"),
        ("nerfstudio", "depth that is missing for a frame"),
        ("nerfstudio", change_json("transforms.json", lambda content: content["frames"][3].pop("depth_file_path"))),
        ("nerfstudio", _with_confidence(lambda content: content["frames"][3].pop("confidence_file_path"))),
        ("nerfstudio", _with_confidence(lambda content: [frame.pop("depth_file_path") for frame in content["frames"]])),
        ("nerfstudio", _with_confidence(dtype="uint16")),
        ("nerfstudio", _MODEL_OF_NOTHING),
        ("nerfstudio", change_json("transforms.json", lambda content: content.update(k4=0.1))),
        ("nerfstudio", "a rotation that is none"),
        ("nerfstudio", "a left-handed pose"),
        ("nerfstudio", "an image of another size"),
        ("nerfstudio", "a depth file of three channels"),
        ("nerfstudio", "an image cut short"),
    ],
}


def examples(page: str) -> list[str]:
    """The second column of the page's table of what is refused."""
    lines = (PAGES / f"{page}.md").read_text().split("| found | example of the message |\n|---|---|\n")[1].splitlines()
    rows = [line.strip("|").split("|") for line in lines if line.startswith("|")]
    return [row[1].strip().strip("`") for row in rows]


@pytest.mark.parametrize(("page", "row"), [(page, row) for page in TOLD for row in range(len(TOLD[page]))])
def test_the_pages_examples_are_what_is_said(copied, page, row):
    told = examples(page)
    assert len(told) == len(TOLD[page])
    name, how = TOLD[page][row]
    folder = copied(name)
    (REFUSED[how][name][0] if isinstance(how, str) else how)(folder)
    with pytest.raises(InputError) as caught:
        load(folder, name)
    said = str(caught.value).replace(f"{folder}/", "")
    # Bytes and the numbers of points are the phantom's.
    assert re.search(re.sub(r"\d{2,}", r"\\d+", re.escape(told[row])), said), said
