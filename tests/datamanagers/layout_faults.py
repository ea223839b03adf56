"""Faults that can befall a folder, by layout: how to spoil its phantom, and the pattern of the message.

A row spoils one thing (``spoiling``) and says what the message must name: the file, what was seen in it, and what would
have been right.
"""

from __future__ import annotations

import re
import shutil
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path

import numpy as np

from coliags_plugin.config.registry import datamanagers
from coliags_plugin.core.scenes import Scene
from tests.datamanagers.spoiling import (
    KINDS,
    Kind,
    Spoil,
    change_binary_pose,
    change_camera,
    change_frame,
    change_json,
    change_line,
    change_matrices,
    change_npz,
    change_row,
    clear,
    cut,
    double_colmap,
    drop_last_line,
    edit,
    files,
    grey,
    half_size,
    mirror,
    mirror_rows,
    paint,
    remove,
    rename,
    rename_channel,
    repaint,
    repeat_last_line,
    shorten,
    spoil_number,
    square,
    stretch,
    three_channels,
    unregistered,
    write_text,
)

#: Kinds whose poses are sixteen numbers a line.
MATRICES = ("c3vd", "c3vd-raw", "c3vd-raw-old", "c3vd-v2", "c3vd-endogslam")
#: Kinds whose poses are frames of a JSON file.
FRAMES_OF_JSON = ("rotatecolon", "nerfstudio", "reim-nerf")
TUM = ("rgbd", "rgbd-by-order", "endomapper")
#: Of them, those with a camera.json, and those whose line n of the trajectory belongs to image n.
TUM_JSON, BY_ORDER = ("rgbd", "rgbd-by-order"), ("rgbd-by-order", "endomapper")
COLMAP = ("colmap", "colmap-text")
#: Kinds with EndoGSLAM's result.
PARAMS = tuple(name for name, kind in KINDS.items() if kind.params)
WITH_DEPTH = tuple(name for name, kind in KINDS.items() if kind.depths)
#: Kinds whose depth, if any, belongs to every image of a number.
PAIRED = ("c3vd", "c3vd-raw", "c3vd-raw-old", "c3vd-v2", "c3vd-endogslam", "pr-endo")
RUBBISH = bytes(range(256))
SIZES = {
    "c3vd": "camera.json",
    "colmap": "cameras.bin",
    "colmap-text": "cameras.txt",
    "nerfstudio": "transforms.json",
    "rgbd": "camera.json",
    "rgbd-by-order": "camera.json",
    "reim-nerf": "transforms_train.json",
    "endomapper": "calibration.xml",
}

Rows = dict[str, list[tuple[Spoil, str]]]
#: Kinds, how to spoil one, and the pattern of the message, in which ``<3>`` is the name of image 3, ``<size>`` the file
#: that says how large images are and ``<poses>`` the pose file.
Row = tuple[str | Iterable[str], Callable[[Kind], Spoil], str]


def load(folder: Path, name: str) -> Scene:
    manager = datamanagers.get(KINDS[name].format)
    return manager(manager.Settings()).load(folder)


def numbered(name: str, place: int) -> str:
    """What the image of a place is called, as a pattern."""
    if name == "rgbd":
        return f"{1_305_031_102 + place / 30:.6f}"
    return f"frame_{place + 1:05d}" if name == "nerfstudio" else rf"0*{place}(_color|_depth)?"


def said_size(name: str) -> str:
    """The file that says how large images are."""
    return SIZES.get(name, rf"{numbered(name, 0)}\.png")


def expanded(table: Mapping[str, list[Row]]) -> dict[str, Rows]:
    """The rows of each fault by kind."""
    result: dict[str, Rows] = {}
    for fault, rows in table.items():
        result[fault] = {}
        for kinds, spoil, message in rows:
            for name in [kinds] if isinstance(kinds, str) else kinds:
                kind = KINDS[name]
                pattern = message.replace("<size>", said_size(name)).replace("<poses>", kind.poses)
                pattern = re.sub(r"<(\d)>", lambda match, name=name: numbered(name, int(match[1])), pattern)
                result[fault].setdefault(name, []).append((spoil(kind), pattern))
    return result


def same(spoil: Callable[[Kind], Spoil], *told: tuple[str | Iterable[str], str]) -> list[Row]:
    """Rows of one way to spoil a folder: kinds, and the pattern of their message."""
    return [(kinds, spoil, message) for kinds, message in told]


def _doubled(*keys: str) -> Callable[[dict], None]:
    return lambda content: content.update({key: 2 * content[key] for key in keys})


_TWICE_K = ("fx", "fy", "cx", "cy")
_TWICE_FL = ("fl_x", "fl_y", "cx", "cy")

#: Faults that can befall several layouts.
ERRORS: dict[str, list[Row]] = {
    "an image of another size": same(
        lambda kind: repaint(kind.images, 4, half_size),
        (KINDS, r"<4>\.png is 32 x 26, but \S*<size> says 64 x 51.*of one size"),
    ),
    "the first image of another size": [
        (KINDS, lambda kind: repaint(kind.images, 0, half_size), r"(32 x 26.*64 x 51|64 x 51.*32 x 26)")
    ],
    "a depth file of another size": same(
        lambda kind: repaint(kind.depths, 0, half_size),
        (WITH_DEPTH, r"<0>\.(png|tiff|exr) is 32 x 26, but \S*<size> says 64 x 51"),
    ),
    "an image cut short": [
        (KINDS, lambda kind: cut(kind.images, 4), r"<4>\.png \(\d+ bytes\) cannot be decoded.*a complete image")
    ],
    "an empty image": [(KINDS, lambda kind: cut(kind.images, 4, 0.0), r"<4>\.png \(0 bytes\) cannot be decoded")],
    "an image of one channel": [
        (KINDS, lambda kind: repaint(kind.images, 4, grey), r"<4>\.png is an image of 1 channel of uint8")
    ],
    "a depth file cut short": [
        (WITH_DEPTH, lambda kind: cut(kind.depths, 5), r"<5>\.(png|tiff|exr) \(\d+ bytes\) cannot be decoded.*complete")
    ],
    "a depth file of three channels": same(
        lambda kind: repaint(kind.depths, 5, three_channels),
        (
            [name for name in WITH_DEPTH if name != "rotatecolon"],
            r"<5>\.(png|tiff) is an image of 3 channels of uint(8|16).*one-channel (8|16)-bit",
        ),
    ),
    "a depth file of other bits": [
        (
            [name for name in WITH_DEPTH if name not in ("rotatecolon", *PARAMS)],
            lambda kind: repaint(kind.depths, 5, lambda depth: (depth // 256).astype(np.uint8)),
            r"<5>\.(png|tiff) is an image of 1 channel of uint8",
        ),
        (
            PARAMS,
            lambda kind: repaint(kind.depths, 5, lambda depth: depth.astype(np.uint16)),
            r"<5>\.tiff is an image of 1 channel of uint16",
        ),
    ],
    "depth that is missing for a frame": same(
        lambda kind: remove(kind.depths, 3),
        ((*PAIRED, *BY_ORDER), "11 images and 10 depth files; frame 3 has only one of the two.*for every image"),
        ("rotatecolon", "depth_train has 10 depth files for 11 frames; frame 3 has none.*for every image"),
        ("nerfstudio", r"transforms\.json, frame images/frame_00004\.png: no file \S*depth/frame_00004\.png"),
        ("reim-nerf", r"names \S*distmaps/0003_color\.png, which does not exist"),
    ),
    "no depth and no points": same(
        lambda kind: remove(kind.depths),
        (
            ("c3vd", "c3vd-raw", "c3vd-v2", "rgbd", "endomapper"),
            r"neither depth files nor points3D\.ply.*points3D\.ply \(world of the poses\)",
        ),
    ),
    "an empty folder": [
        (KINDS, lambda _: clear, "(holds nothing|holds no COLMAP model|no file .*transforms.json).*Expected")
    ],
    "no images": same(
        lambda kind: remove(kind.images),
        (KINDS, "(holds nothing|holds 0000_depth|have no image|are not in|has no image|does not exist).*Expected"),
    ),
    "an image that is gone": same(
        lambda kind: remove(kind.images, 3),
        (PAIRED, "has 10 images, numbers 0 to 10, but none is 3.*without gaps"),
        ("rotatecolon", r"transforms\.json: frame 3 has no image \S*0003\.png"),
        (COLMAP, r"1 of the 11 images of \S*sparse/0 are not in \S*images: 0003\.png"),
        ("nerfstudio", r"transforms\.json: 1 of 11 frames have no image in .*images/frame_00004\.png"),
        (BY_ORDER, r"<poses> has 11 poses for 10 images"),
        ("reim-nerf", r"names \S*images/0003_color\.png, which does not exist"),
    ),
    "two images of one number": same(
        lambda kind: (
            lambda folder: shutil.copy(image := files(folder, kind.images)[4], image.with_name(f"00{image.name}"))
        ),
        (("c3vd", "c3vd-raw-old", "c3vd-v2", "c3vd-endogslam", *BY_ORDER), "have the same number"),
    ),
    "numbers from one on": same(
        lambda kind: rename([kind.images, kind.depths], lambda number: number + 1),
        (("c3vd", "c3vd-v2"), "numbers 1 to 11, but none is 0"),
    ),
    "no pose file": same(
        lambda kind: remove(kind.poses),
        (("c3vd", "c3vd-raw", "c3vd-v2"), "has images but no <poses>"),
        ("c3vd-endogslam", "no pose.txt"),
        (TUM, r"has images but no groundtruth\.txt or poses\.txt"),
        ("reim-nerf", r"Add transforms_train\.json"),
    ),
    "fewer poses than images": [
        (
            (*MATRICES, *BY_ORDER),
            lambda kind: drop_last_line(kind.poses),
            "<poses> has 10 poses for 11 images.*a pose for every image",
        ),
        (
            PARAMS,
            lambda kind: change_npz(kind.params, lambda arrays: shorten(arrays, 2)),
            r"params\.npz has [89] poses for 11 images.*Expected 11",
        ),
    ],
    "more poses than images": [
        (
            (*MATRICES, *BY_ORDER),
            lambda kind: repeat_last_line(kind.poses),
            "<poses> has 12 poses for 11 images.*a pose for every image",
        ),
        (
            FRAMES_OF_JSON,
            lambda kind: change_json(
                kind.poses,
                lambda content: content["frames"].append({**content["frames"][-1], "file_path": "images/99"}),
            ),
            r"<poses>(: frame 99 has no image| names \S*images/99|: 1 of 12 frames have no image).*Expected",
        ),
    ],
    "no poses": [
        ((*MATRICES, *TUM, "colmap-text"), lambda kind: cut(kind.poses, 0, 0.0), "<poses> holds no poses.*Expected"),
        (FRAMES_OF_JSON, lambda kind: cut(kind.poses, 0, 0.0), "<poses> is not JSON.*Expected"),
    ],
    "no frames": same(
        lambda kind: change_json(kind.poses, lambda content: content["frames"].clear()),
        (FRAMES_OF_JSON, "<poses> has no frames"),
    ),
    "a pose file cut short": [
        ((*MATRICES, *TUM), lambda kind: cut(kind.poses), r"<poses>, line \d+: '.*'.*\d+ finite numbers"),
        (FRAMES_OF_JSON, lambda kind: cut(kind.poses), r"<poses> is not JSON: .* line \d+.*Expected"),
        (
            "colmap-text",
            # The last observation loses its point; cut between two, the file is a whole one of fewer images.
            lambda kind: (
                lambda folder: write_text(kind.poses, (folder / kind.poses).read_bytes().rstrip().rpartition(b" ")[0])(
                    folder
                )
            ),
            r"images\.txt, line \d+: .*Expected X Y POINT3D_ID of each point",
        ),
        ("colmap", lambda _: cut("sparse/0/images.bin"), r"images\.bin \(\d+ bytes\) is damaged or cut short"),
        (
            PARAMS,
            lambda kind: lambda folder: write_text(kind.params, (folder / kind.params).read_bytes()[:4000])(folder),
            r"cannot read \S*params\.npz.*written by EndoGSLAM",
        ),
    ],
    "a pose file of something else": same(
        lambda kind: write_text(kind.poses, RUBBISH),
        ((*MATRICES, *TUM, *FRAMES_OF_JSON, "colmap-text"), r"cannot read \S*<poses>.*Expected"),
    ),
    "a trajectory of another format": [
        (TUM, lambda kind: write_text(kind.poses, "1,0,0,0,0,1,0,0,0,0,1,0,0,0,0,1\n"), "<poses>, line 1: '1,0,0,0")
    ],
    "a result that is no archive": [
        (PARAMS, lambda kind: write_text(kind.params, "PK nonsense"), r"cannot read \S*params\.npz")
    ],
    "a number that is none": [
        (
            MATRICES,
            lambda kind: change_matrices(kind.poses, lambda matrices: spoil_number(matrices[3])),
            "<poses>, line 4: 'nan,.*16 finite numbers",
        ),
        (
            FRAMES_OF_JSON,
            lambda kind: change_frame(kind.poses, 1, spoil_number),
            r"<poses>, frame 1 \(.*\): transform_matrix.*rows of 4 finite numbers",
        ),
        (
            TUM,
            lambda kind: change_row(kind.poses, 3, 4, lambda quat: quat * np.nan),
            r"<poses>, line \d+: '.*8 finite numbers",
        ),
        (
            "colmap-text",
            lambda kind: change_row(kind.poses, 6, 1, lambda quat: quat * np.nan),
            r"images\.txt, line \d+: '4 nan.*all finite",
        ),
        (
            "colmap",
            lambda _: change_binary_pose(3, lambda values: values * np.nan),
            r"images\.bin, image \d+ .*its pose is nan",
        ),
        (
            PARAMS,
            lambda kind: change_npz(kind.params, lambda arrays: arrays.update(cam_trans=arrays["cam_trans"] * np.nan)),
            r"params\.npz: cam_trans holds numbers that are not finite",
        ),
    ],
    "a word for a pose": [(MATRICES, lambda kind: change_line(kind.poses, 2, "none"), "<poses>, line 3: 'none'")],
    "no matrix": same(
        lambda kind: change_json(kind.poses, lambda content: content["frames"][1].pop("transform_matrix")),
        (FRAMES_OF_JSON, r"<poses>, frame 1 \(.*\): transform_matrix"),
    ),
    "a rotation that is none": [
        (
            MATRICES,
            lambda kind: change_matrices(kind.poses, lambda matrices: stretch(matrices[3])),
            r"<poses>, line 4: not a rigid transform \(R\^T R is 3.*within 0\.001",
        ),
        (
            FRAMES_OF_JSON,
            lambda kind: change_frame(kind.poses, 1, stretch),
            r"<poses>, frame 1 \(.*\): not a rigid transform \(R\^T R is 3.*within 0\.001",
        ),
        (
            TUM,
            lambda kind: change_row(kind.poses, 3, 4, lambda quat: 2.0 * quat),
            r"<poses>, line \d+: a quaternion of length 2.*length 1",
        ),
        (
            "colmap-text",
            lambda kind: change_row(kind.poses, 6, 1, lambda quat: 2.0 * quat),
            r"images\.txt, line \d+: a quaternion of length 2.*length 1",
        ),
        (
            "colmap",
            lambda _: change_binary_pose(3, lambda values: 2.0 * values),
            r"images\.bin, image 4 \(0003\.png\): a quaternion of length 2.*length 1",
        ),
        (
            PARAMS,
            lambda kind: change_npz(kind.params, lambda arrays: arrays["cam_unnorm_rots"][..., 3].fill(0.0)),
            r"params\.npz, cam_unnorm_rots, frame 3: the quaternion \(0, 0, 0, 0\) is not a rotation",
        ),
    ],
    "a left-handed pose": [
        (
            MATRICES,
            lambda kind: change_matrices(
                kind.poses, lambda matrices: (mirror if kind is KINDS["c3vd-raw-old"] else mirror_rows)(matrices[3])
            ),
            r"<poses>, line 4: a left-handed transform \(det R = -1\).*x right, y down, z forward",
        ),
        (
            FRAMES_OF_JSON,
            lambda kind: change_frame(kind.poses, 1, mirror),
            r"<poses>, frame 1 \(.*\): a left-handed transform.*right-handed",
        ),
        (
            PARAMS,
            lambda kind: change_npz(kind.params, lambda arrays: mirror(arrays["gt_w2c_all_frames"][3])),
            r"params\.npz, gt_w2c_all_frames, frame 3: a left-handed transform.*right-handed",
        ),
    ],
    "intrinsics of another resolution": [
        (
            ("c3vd", *TUM_JSON),
            lambda _: change_json("camera.json", _doubled(*_TWICE_K, "w", "h")),
            r"\.png is 64 x 51, but \S*camera\.json says 128 x 102",
        ),
        (
            "nerfstudio",
            lambda kind: change_json(kind.poses, _doubled(*_TWICE_FL, "w", "h")),
            r"frame_00001\.png is 64 x 51, but \S*transforms\.json says 128 x 102",
        ),
        (
            "reim-nerf",
            lambda _: change_json("transforms_*.json", _doubled(*_TWICE_K, "w", "h")),
            r"rgb_mask\.png is 64 x 51.*128 x 102",
        ),
        ("colmap", lambda _: double_colmap(size=True), r"0000\.png is 64 x 51, but \S*cameras\.bin says 128 x 102"),
        (
            PARAMS,
            lambda kind: change_npz(
                kind.params, lambda arrays: arrays.update(intrinsics=arrays["intrinsics"] * [[2], [2], [1]])
            ),
            r"params\.npz: the principal point .* is 5\d % of the image.*org_width",
        ),
        (
            "c3vd-v2",
            lambda _: (
                lambda folder: write_text(
                    "camera_intrinsics.txt",
                    (folder / "camera_intrinsics.txt").read_text().replace("cx = 677", "cx = 338"),
                )(folder)
            ),
            r"camera_intrinsics\.txt is ambiguous or implausible: a centre \(338\.739, 543\.058\) far",
        ),
        (
            "rotatecolon",
            lambda kind: change_json(kind.poses, lambda content: content.update(camera_angle_x=80.0)),
            r"transforms\.json: camera_angle_x is 80.*radians",
        ),
    ],
    "no camera file": [
        ("c3vd", lambda _: remove("camera.json"), r"has images but no camera\.json"),
        *(
            (
                kinds,
                lambda _, file=file: remove(file),
                r"but no camera\.json, intrinsics\.txt, cameras\.txt or calibration",
            )
            for kinds, file in ((TUM_JSON, "camera.json"), ("endomapper", "calibration.xml"))
        ),
    ],
    "a camera file cut short": [
        ("endomapper", lambda _: cut("calibration.xml"), r"calibration\.xml is not XML: .*line \d+.*Restore"),
        (("c3vd", *TUM_JSON), lambda _: cut("camera.json"), r"camera\.json is not JSON: .* line.*JSON object"),
        (
            "c3vd-v2",
            lambda _: cut("camera_intrinsics.txt"),
            r"camera_intrinsics\.txt is ambiguous or implausible: no a3, a4",
        ),
        ("colmap", lambda _: cut("sparse/0/cameras.bin"), r"cameras\.bin \(\d+ bytes\) is damaged or cut short"),
        ("colmap-text", lambda _: cut("sparse/0/cameras.txt", 0, 0.9), r"cameras\.txt, line 4: '1 PINHOLE 64 51"),
    ],
    "camera.json without numbers": [
        (("c3vd", *TUM_JSON), lambda _: write_text("camera.json", "[]"), r"camera\.json has no fx, fy")
    ],
    "camera.json without keys": [
        (("c3vd", *TUM_JSON), lambda _: change_camera(fx=None, cy=None), r"camera\.json has no fx, cy")
    ],
    "a word for a focal length": [(("c3vd", *TUM_JSON), lambda _: change_camera(fx="wide"), r"camera\.json: .*'wide'")],
    "no focal length": [
        (("c3vd", *TUM_JSON), lambda _: change_camera(fy=0), r"camera\.json: .*above 0"),
        ("reim-nerf", lambda _: change_camera("transforms_*.json", fy=0), r"transforms_train\.json: .*above 0"),
    ],
    "half pixels": [
        (("c3vd", *TUM_JSON), lambda _: change_camera(w=64.5), "whole pixels"),
        ("reim-nerf", lambda _: change_camera("transforms_*.json", h=51.5), "w = 64.0, h = 51.5"),
    ],
    "a crop": same(
        lambda kind: repaint(kind.images, 0, square),
        (("c3vd-raw", "c3vd-v2"), "<0>.png is 50 x 50.*undistorted layout"),
    ),
    "another file of the layout cut short": [
        ("colmap", lambda _: cut("sparse/0/points3D.bin"), r"points3D\.bin \(\d+ bytes\) is damaged or cut short"),
        ("colmap-text", lambda _: cut("sparse/0/points3D.txt", lines=100), r"points3D\.txt has 97 points, but not \d+"),
        (
            "rotatecolon",
            lambda _: cut("init_point_cloud.ply"),
            r"init_point_cloud\.ply says it has \d+ vertices, but holds",
        ),
        ("reim-nerf", lambda _: cut("rgb_mask.png"), r"rgb_mask\.png \(\d+ bytes\) cannot be decoded"),
        (
            "pr-endo",
            lambda _: cut("../../C3VD_endogslam_optimized/phantom/point_cloud/iteration_30000/point_cloud.ply"),
            r"point_cloud\.ply says it has 20000 vertices, but holds \d+",
        ),
        ("c3vd", lambda _: cut("rotation/camera_pose.txt"), r"rotation/camera_pose\.txt, line \d: '"),
        (
            "c3vd-raw",
            lambda _: cut("rotation/*_depth.tiff"),
            r"rotation/0000_depth\.tiff \(\d+ bytes\) cannot be decoded",
        ),
        ("c3vd-v2", lambda _: cut("rotation/rgb/*.png"), r"rotation/rgb/0000\.png \(\d+ bytes\) cannot be decoded"),
        ("c3vd-endogslam", lambda _: cut("rotation/pose.txt"), r"rotation/pose\.txt, line \d: '"),
    ],
    "a model without images": [
        ("colmap", lambda _: unregistered, r"images\.bin holds no poses.*at least one registered image"),
        (
            "colmap-text",
            lambda _: lambda folder: shutil.rmtree(folder / "images"),
            r"no folder \S*images.*the images that the model was made from",
        ),
    ],
    "another channel than expected": same(
        lambda kind: rename_channel(kind.depths, 4, "ViewLayer.Depth.Z", "View Layer.Depth.Z"),
        (
            "rotatecolon",
            r"0004\.exr has the channels View Layer\.Depth\.Z, .*R.*a channel ViewLayer\.Depth\.Z.*depth_channel",
        ),
    ),
    "a depth scale that nobody says": same(
        lambda kind: (
            change_camera(depth_scale=None) if kind.format == "rgbd" else edit("calibration.xml", r"<depth_.*", "")
        ),
        (TUM, "their number of steps per unit.*5000 steps per metre.*depth_scale=5000"),
    ),
}
REFUSED = expanded(ERRORS)


def _frame(index: int, change: Callable[[dict], object], pattern: str = "transforms_*.json") -> Spoil:
    return change_json(pattern, lambda content: change(content["frames"][index]))


_TURNED = [[0.0, -1.0, 0.0, 0.0], [1.0, 0.0, 0.0, 0.0], [0.0, 0.0, 1.0, 0.0], [0.0, 0.0, 0.0, 1.0]]

#: Faults of one layout: by kind, how to spoil it and the pattern of the message.
OWN: dict[str, list[tuple[Spoil, str]]] = {
    "c3vd": [
        (rename(["images/*.png"], lambda number: f"frame{number}"), "images holds frame0_color.png"),
        (paint("0000_color.png", (51, 64, 3)), r"holds both 0000_color\.png and images/"),
        (remove("images/*.png", 10), "10 images and 11 depth files; frame 10"),
    ],
    "c3vd-endogslam": [
        (
            change_matrices("pose.txt", lambda matrices: matrices[[*range(1, 11), 0]]),
            r"params\.npz: the true pose of image \d+ is .* mm and .* degrees from that of .*pose\.txt",
        ),
        (change_npz("params.npz", lambda arrays: arrays.pop("means3D")), "no means3D"),
        (change_npz("params.npz", lambda arrays: arrays.pop("org_width")), "no org_width"),
        (
            change_npz("params.npz", lambda arrays: arrays.update(org_width=np.array(800), org_height=np.array(540))),
            r"0000_color\.png is 64 x 51, but .*params\.npz is for 800 x 540",
        ),
    ],
    "rotatecolon": [
        (write_text("transforms.json", "{}"), r"transforms\.json has no frames"),
        (change_json("transforms.json", lambda content: content.pop("camera_angle_x")), "camera_angle_x is None"),
        (
            change_json("transforms_test.json", lambda content: content.update(camera_angle_x=80.0)),
            r"transforms_test\.json: camera_angle_x is 80.0",
        ),
        (remove("test_views_1/*.png", 1), "frame 1 has no .*test_views_1"),
        (_frame(2, lambda frame: frame.update(file_path="r_2"), "transforms.json"), "file_path 'r_2'"),
        (_frame(2, lambda frame: frame.update(file_path="0001"), "transforms.json"), "frame 1 is repeated"),
    ],
    "rgbd": [
        (lambda folder: shutil.rmtree(folder / "rgb"), r"data holds camera\.json, depth\.txt, depth/"),
        (lambda folder: (folder / "images").mkdir(), "holds rgb/ and images/"),
        (lambda folder: (folder / "depths").mkdir(), "holds depth/ and depths/"),
        (
            lambda folder: shutil.copy(folder / "groundtruth.txt", folder / "slam_poses.txt"),
            r"has the trajectories groundtruth\.txt, slam_poses\.txt.*--set datamanager\.trajectory=groundtruth\.txt",
        ),
        (
            lambda folder: (folder / "rgb/1305031102.000000.png").rename(folder / "rgb/0.png"),
            r"rgb/0\.png is not named by a timestamp",
        ),
        *((change_camera(depth_scale=scale), "depth_scale") for scale in (0, -5.0, "5000", True)),
    ],
    "endomapper": [
        (edit("calibration.xml", "_kb4", "_fov"), r"calibration\.xml: the camera model 'calibu_fu_fv_u0_v0_fov'"),
        (edit("calibration.xml", "> 64 <", "> 128 <"), r"0000\.png is 64 x 51, but \S*calibration\.xml says 128 x 51"),
        (
            lambda folder: edit("other.xml", "> 64 <", "> 65 <")(
                shutil.copy(folder / "calibration.xml", folder / "other.xml").parent
            ),
            r"calibration\.xml and other\.xml have different cameras",
        ),
        (remove("mask/*.png", 3), r"mask has no mask for 0003\.png"),
    ],
    "reim-nerf": [
        (remove("transforms_true_test.json"), r"has no transforms_true_test\.json.*choose another split"),
        (write_text("transforms_val.json", "{"), r"transforms_val\.json is not JSON"),
        (_frame(1, lambda frame: frame.pop("file_path"), "*_train.json"), r"_train\.json, frame 1: no file_path"),
        (
            change_frame("transforms_test.json", 0, lambda matrix: matrix.__setitem__((0, 3), 0.5)),
            r"_test\.json: pose or distance map of images/0000_color\.png differs",
        ),
        (
            change_json("transforms_train.json", lambda content: content["frames"].append(content["frames"][0])),
            r"_train\.json: 'images/0000_color\.png' is repeated",
        ),
        (change_camera("*_val.json", scene_scale=0.5), r"_val\.json: scene_scale differs from transforms_train\.json"),
        (change_camera("transforms_*.json", scene_scale=None), r"_train\.json: scene_scale is None"),
        (change_camera("transforms_*.json", scene_scale=0.0), r"_train\.json: scene_scale is 0"),
        (change_camera("transforms_*.json", distmap_scale=-1.0), r"_train\.json: distmap_scale is -1"),
        (change_camera("transforms_*.json", scene_T=_TURNED), r"_train\.json: scene_T is not a translation"),
        (change_camera("transforms_*.json", scene_T=None), r"_train\.json: scene_T is not a translation"),
        (change_camera("transforms_*.json", camera_model="OPENCV"), "camera_model 'OPENCV'.*FISHEYE_OPENCV"),
        (change_camera("transforms_*.json", w=None), r"_train\.json: w is None"),
        (change_camera("transforms_*.json", p1=0.01), r"_train\.json: p1 = 0.01"),
        (
            change_json(
                "transforms_*.json",
                lambda content: [f.pop("distmap_path") for f in content["frames"] if "0005" in f["file_path"]],
            ),
            r"images/0005_color\.png has no distmap_path, but others have",
        ),
        (remove("rgb_mask.png"), r"no file .*rgb_mask\.png.*mask=false"),
        (paint("rgb_mask.png", (26, 32)), r"rgb_mask\.png is 32 x 26.*64 x 51"),
        (
            repaint("rgb_mask.png", 0, lambda mask: np.dstack([mask, mask // 2, mask])),
            r"rgb_mask\.png is a colour image.*three equal ones",
        ),
    ],
}


REFUSED["one of its own"] = OWN

_DOUBLE_K = r"the principal point is (4\d|5\d)% of the image \(64 x 51\) from its middle.*another resolution"

WARNINGS: dict[str, list[Row]] = {
    "intrinsics of another resolution that say they are of this one": [
        (("c3vd", "rgbd"), lambda _: change_json("camera.json", _doubled(*_TWICE_K)), rf"camera\.json: {_DOUBLE_K}"),
        ("colmap", lambda _: double_colmap(size=False), rf"cameras\.bin: {_DOUBLE_K}"),
        ("nerfstudio", lambda kind: change_json(kind.poses, _doubled(*_TWICE_FL)), rf"transforms\.json: {_DOUBLE_K}"),
        (
            "reim-nerf",
            lambda _: change_json("transforms_*.json", _doubled(*_TWICE_K)),
            rf"transforms_train\.json: {_DOUBLE_K}",
        ),
    ],
    "images without a pose": [
        (
            "rotatecolon",
            lambda kind: change_json(kind.poses, lambda content: content["frames"].pop()),
            r"transforms\.json: 1 images of train_views have no pose and are left out",
        ),
        (
            "nerfstudio",
            lambda kind: change_json(kind.poses, lambda content: content["frames"].pop()),
            r"transforms\.json: 1 images have no pose and are left out: frame_00011\.png",
        ),
        (
            "colmap",
            lambda _: lambda folder: shutil.copy(folder / "images/0000.png", folder / "images/0011.png"),
            r"images\.bin: 1 images have no pose and are left out: 0011\.png",
        ),
        (
            "reim-nerf",
            lambda _: lambda folder: shutil.copy(folder / "images/0000_color.png", folder / "images/0011_color.png"),
            r"1 images have no pose and are left out: 0011_color\.png",
        ),
        ("rgbd", lambda kind: drop_last_line(kind.poses), r"of 11 images 1 have no pose and 0 no depth within 0\.02 s"),
    ],
    "depth that is missing for a frame": [
        ("rgbd", lambda kind: remove(kind.depths, 3), r"of 11 images 0 have no pose and 1 no depth within 0\.02 s")
    ],
}
WARNED = expanded(WARNINGS)


def every_row(table: dict[str, Rows]) -> list[tuple[str, str, int]]:
    return [(fault, name, row) for fault in table for name, rows in table[fault].items() for row in range(len(rows))]
