"""The nerfstudio data manager: cameras, files, splits, its phantom, a real sequence, and what is refused."""

from __future__ import annotations

import json
import math
import shutil
from dataclasses import astuple, replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch

from coliags_plugin.core.errors import InputError
from coliags_plugin.core.images import read_rgb
from coliags_plugin.core.ply import point_properties, write_ply
from coliags_plugin.datamanagers.fusion import load_points
from coliags_plugin.datamanagers.nerfstudio.reader import NerfstudioDataManager, NerfstudioSettings
from coliags_plugin.datamanagers.recognition import find_format
from coliags_plugin.datamanagers.units import write_unit
from coliags_plugin.geometry.lenses.models import FisheyeLens, Lens
from coliags_plugin.geometry.lenses.tabulated import OpenCVLens
from coliags_plugin.geometry.lenses.undistortion import Undistortion
from coliags_plugin.geometry.poses.rigid import FLIP_Y_AND_Z
from tests.datamanagers.real_frames import real_lens
from tests.datamanagers.wall_scenes import PINHOLE, look, off_wall, poses, rays
from tests.phantom.phantom_layouts import in_video_order, read, write_phantom

WIDTH, HEIGHT = 64, 48
SIZE = vars(PINHOLE)
BROWN = {"k1": -0.15, "k2": 0.03, "k3": 0.004, "p1": 0.003, "p2": -0.004}
FISHEYE = {"k1": -0.05, "k2": 0.01, "k3": 0.003, "k4": -0.001}
#: The file's keys, pixel centres at integers + 0.5.
CAMERA = {"fl_x": PINHOLE.fx, "fl_y": PINHOLE.fy, "cx": PINHOLE.cx, "cy": PINHOLE.cy, "w": WIDTH, "h": HEIGHT}
COUNT = 9


def load(folder: Path, **options):
    return NerfstudioDataManager(NerfstudioSettings(**options)).load(folder)


def opened(folder: Path, **options):
    return NerfstudioDataManager(NerfstudioSettings(**options)).open(folder)


def write(folder: Path, lens: Lens | None = None, names: list[str] | None = None, frame_keys=None, **content) -> Path:
    """The tilted wall, in millimetres, with points3D.ply beside it; ``content`` goes into the file, None out of it."""
    names = names or [f"images/frame_{index + 1:05d}.png" for index in range(COUNT)]
    frames = []
    for index, (name, pose) in enumerate(zip(names, poses(len(names)), strict=True)):
        depth, color = look(pose, rays(lens or PINHOLE))
        path = folder / (name if Path(name).suffix else f"{name}.png")
        path.parent.mkdir(parents=True, exist_ok=True)
        cv2.imwrite(str(path), color[..., ::-1])
        frame = {"file_path": name, "transform_matrix": (pose @ FLIP_Y_AND_Z).tolist()}
        frames.append({**frame, **(frame_keys(index, depth) if frame_keys else {})})
        points = pose[:3, 3] + depth.reshape(-1, 1) * rays(lens or PINHOLE).reshape(-1, 3) @ pose[:3, :3].T
    write_ply(folder / "points3D.ply", point_properties(points, np.full(points.shape, 128, np.uint8)))
    content = {"camera_model": "OPENCV", **CAMERA, "frames": frames, **content}
    content = {key: value for key, value in content.items() if value is not None}
    (folder / "transforms.json").write_text(json.dumps(content))
    return folder


def changed(folder: Path, **content) -> Path:
    """The file with other keys; None removes one."""
    path = folder / "transforms.json"
    content = {**json.loads(path.read_text()), **content}
    path.write_text(json.dumps({key: value for key, value in content.items() if value is not None}))
    return folder


@pytest.fixture(scope="module")
def wall(tmp_path_factory) -> Path:
    return write(tmp_path_factory.mktemp("nerfstudio") / "wall")


@pytest.fixture
def folder(wall, tmp_path) -> Path:
    """A copy to be spoilt."""
    return Path(shutil.copytree(wall, tmp_path / "wall"))


# Cameras


@pytest.mark.parametrize(
    ("model", "bends", "lens"),
    [
        ("PINHOLE", {}, None),
        ("SIMPLE_PINHOLE", {}, None),
        ("OPENCV", {}, None),
        ("OPENCV", {"k1": 0.0, "k4": 0.0}, None),
        ("OPENCV", BROWN, OpenCVLens(**SIZE, **BROWN)),
        ("OPENCV_FISHEYE", FISHEYE, FisheyeLens(**SIZE, **FISHEYE)),
        ("OPENCV_FISHEYE", {}, FisheyeLens(**SIZE, k1=0, k2=0, k3=0, k4=0)),
    ],
)
def test_images_of_every_camera_become_pinhole_images(tmp_path, model, bends, lens):
    scene = load(write(tmp_path, lens, camera_model=model, **bends))
    for frame in in_video_order(scene):
        cam = frame.camera
        assert (cam.fx, cam.fy, cam.cx, cam.cy) == (PINHOLE.fx, PINHOLE.fy, PINHOLE.cx, PINHOLE.cy)
        np.testing.assert_allclose(cam.camera_to_world, poses(COUNT)[frame.index], atol=1e-6)
        _, color = look(poses(COUNT)[frame.index], rays(PINHOLE))
        off = np.abs(color.astype(int) - frame.image.numpy())[frame.valid.numpy()]
        if lens is None:
            assert off.max() == 0
        assert np.mean(off) < 0.6 and np.quantile(off, 0.999) <= 4
        assert frame.valid.float().mean() > 0.75


def test_a_frames_own_camera_goes_before_the_files(tmp_path):
    def keys(index, depth):
        return {"fl_x": 70.0, "k1": -0.1} if index == 3 else {}

    frames = in_video_order(load(write(tmp_path, frame_keys=keys)))
    assert [frame.camera.fx for frame in frames] == [61.0, 61.0, 61.0, 70.0, *[61.0] * 5]
    shots = opened(tmp_path).shots
    assert len({id(shot.rectification) for shot in shots}) == 2


@pytest.mark.parametrize("axis", ["x", "y"])
def test_an_angle_of_view_stands_for_a_focal_length(tmp_path, axis):
    half = 0.5 * (WIDTH if axis == "x" else HEIGHT)
    angle = {f"camera_angle_{axis}": 2.0 * math.atan(half / 61.0)}
    cam = (
        opened(write(tmp_path, fl_x=None, fl_y=None, cx=None, cy=None, w=None, h=None, **angle)).shots[0].rectification
    )
    assert astuple(cam.pinhole) == pytest.approx((61.0, 61.0, 32.0, 24.0, WIDTH, HEIGHT))


def test_where_pixel_centres_are_counted(wall):
    half, whole = (opened(wall, pixel_centers=kind).shots[0].rectification.pinhole for kind in ("half", "integer"))
    assert half == PINHOLE
    assert whole == replace(PINHOLE, cx=PINHOLE.cx + 0.5, cy=PINHOLE.cy + 0.5)


def test_instant_ngps_word_for_a_fisheye(tmp_path):
    rectification = opened(write(tmp_path, camera_model=None, is_fisheye=True, **FISHEYE)).shots[0].rectification
    assert rectification.lens == FisheyeLens(**SIZE, **FISHEYE)


# Poses and files


def test_names_in_the_order_of_their_numbers(tmp_path):
    names = ["./images/frame_10", "./images/frame_9", "./images/frame_100", "./images/frame_1"]
    shots = opened(write(tmp_path, names=names)).shots
    assert [shot.name for shot in shots] == ["frame_1", "frame_9", "frame_10", "frame_100"]
    for shot, index in zip(shots, (3, 1, 0, 2), strict=True):
        np.testing.assert_allclose(shot.camera_to_world, poses(4)[index], atol=1e-12)
        assert shot.image.resolve() == (tmp_path / f"{names[index]}.png").resolve()


def test_names_in_sub_folders(tmp_path):
    names = ["images/cam1/2.jpg", "images/cam0/10.jpg", "images/cam0/9.jpg"]
    assert [shot.name for shot in opened(write(tmp_path, names=names)).shots] == ["cam0-9", "cam0-10", "cam1-2"]


def test_nerfstudios_change_of_the_world_is_undone_for_poses_and_points(wall, folder):
    applied = np.array([[0.0, 1.0, 0.0, 3.0], [1.0, 0.0, 0.0, -2.0], [0.0, 0.0, -1.0, 5.0]])
    content = json.loads((folder / "transforms.json").read_text())
    for frame in content["frames"]:
        moved = np.vstack([applied, [0, 0, 0, 1]]) @ np.array(frame["transform_matrix"])
        moved[:3, 3] *= 0.5
        frame["transform_matrix"] = moved.tolist()
    points = load_points(folder / "points3D.ply").positions.double().numpy()
    moved_points = 0.5 * (points @ applied[:, :3].T + applied[:, 3])
    write_ply(folder / "sparse_pc.ply", point_properties(moved_points, np.zeros(points.shape, np.uint8)))
    changed(
        folder,
        frames=content["frames"],
        applied_transform=applied.tolist(),
        applied_scale=0.5,
        ply_file_path="sparse_pc.ply",
    )
    before, after = load(wall), load(folder)
    for one, other in zip(before.train, after.train, strict=True):
        torch.testing.assert_close(one.camera.camera_to_world, other.camera.camera_to_world, atol=1e-5, rtol=0)
    assert off_wall(after.points.positions.double().numpy()).max() < 1e-3
    assert any("undone" in remark for remark in after.provenance["pose_convention"]["remarks"])


def depth_files(folder: Path, unit: float, suffix: str):
    def keys(index, depth):
        path = folder / f"depth/{index}{suffix}"
        path.parent.mkdir(parents=True, exist_ok=True)
        if suffix == ".npy":
            np.save(path, (depth / unit).astype(np.float32))
        else:
            cv2.imwrite(str(path), np.rint(depth / unit).astype(np.uint16))
        return {"depth_file_path": f"depth/{index}{suffix}"}

    return keys


@pytest.mark.parametrize("suffix", [".png", ".npy"])
@pytest.mark.parametrize(
    ("unit", "content", "options"),
    [
        (1.0, {}, {}),
        (0.01, {"depth_unit_scale_factor": 0.01}, {}),
        (0.01, {"depth_unit_scale_factor": 0.5}, {"depth_unit_scale_factor": 0.01}),
    ],
    ids=["a millimetre unless said", "the file says", "an option says"],
)
def test_depth_files(tmp_path, unit, content, options, suffix):
    scene = load(write(tmp_path, frame_keys=depth_files(tmp_path, unit, suffix), **content), **options)
    for frame in scene.train:
        expected, _ = look(poses(COUNT)[frame.index], rays(PINHOLE))
        np.testing.assert_allclose(frame.depth.numpy(), expected, atol=0.51 * unit if suffix == ".png" else 1e-4)
    assert scene.provenance["depth_unit"] == unit
    assert off_wall(scene.points.positions.double().numpy()).max() < unit


def test_metres_become_millimetres(tmp_path):
    write(tmp_path, frame_keys=depth_files(tmp_path, 0.1, ".png"), depth_unit_scale_factor=1e-4)
    content = json.loads((tmp_path / "transforms.json").read_text())
    for frame in content["frames"]:
        for row in frame["transform_matrix"][:3]:
            row[3] /= 1000.0
    points = load_points(tmp_path / "points3D.ply").positions.numpy() / 1000.0
    write_ply(tmp_path / "metres.ply", point_properties(points, np.zeros(points.shape, np.uint8)))
    changed(tmp_path, frames=content["frames"], ply_file_path="metres.ply")
    assert not load(tmp_path).is_metric
    write_unit(tmp_path, "m")
    scene = load(tmp_path, initial_points="data")
    assert scene.is_metric
    for frame in scene.train:
        np.testing.assert_allclose(frame.camera.camera_to_world, poses(COUNT)[frame.index], atol=1e-5)
        assert off_wall(frame.camera.unproject(frame.depth).reshape(-1, 3).double().numpy()).max() < 0.06
    assert off_wall(scene.points.positions.double().numpy()).max() < 1e-3
    scaled = load(tmp_path, unit="mm", scale=1000.0, initial_points="data")
    torch.testing.assert_close(scaled.train[1].depth, scene.train[1].depth, equal_nan=True)
    torch.testing.assert_close(scaled.points.positions, scene.points.positions)


def test_depth_files_are_in_millimetres_by_default_whatever_the_unit(tmp_path):
    write(tmp_path, frame_keys=depth_files(tmp_path, 0.1, ".npy"))
    assert float(load(tmp_path, unit="mm").train[0].depth.nanmedian()) == pytest.approx(
        float(load(tmp_path, unit="m").train[0].depth.nanmedian())
    )


def test_masks_of_some_frames(tmp_path):
    mask = np.full((HEIGHT, WIDTH), 255, np.uint8)
    mask[5:20, 3:9] = 0

    def keys(index, depth):
        return {"mask_path": "mask.png"} if index % 2 else {}

    write(tmp_path, frame_keys=keys)
    cv2.imwrite(str(tmp_path / "mask.png"), mask)
    for frame in in_video_order(load(tmp_path)):
        if frame.index % 2:
            np.testing.assert_array_equal(frame.mask.numpy(), mask > 0)
        else:
            assert frame.mask is None


def test_the_files_own_split(folder):
    names = [f"images/frame_{index + 1:05d}.png" for index in range(COUNT)]
    changed(folder, train_filenames=["./" + name for name in names[:5]], val_filenames=names[5:7])
    scene = load(folder, split="own")
    assert [frame.index for frame in scene.train] == [0, 1, 2, 3, 4]
    assert [frame.index for frame in scene.test_sets["test"]] == [5, 6]
    changed(folder, test_filenames=names[7:])
    assert [frame.index for frame in load(folder, split="own").test_sets["test"]] == [7, 8]
    assert [frame.index for frame in load(folder).test_sets["test"]] == [0, 8]


def test_no_split_of_its_own(wall):
    with pytest.raises(InputError, match="does not specify its test frames"):
        load(wall, split="own")


def test_recognised_by_its_file(wall, folder):
    assert find_format(wall) == "nerfstudio"
    (folder / "sparse/0").mkdir(parents=True)
    assert find_format(folder) == "nerfstudio"
    (folder / "transforms_test.json").write_text("{}")
    assert NerfstudioDataManager.recognise(folder) is None


def test_the_fingerprint_sees_the_file(folder):
    before = opened(folder).fingerprint
    changed(folder, fl_x=62.0)
    assert opened(folder).fingerprint != before


# What is refused


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ({"camera_model": "EQUIRECTANGULAR"}, r"frame_00001\.png: camera_model is EQUIRECTANGULAR"),
        ({"camera_model": "SIMPLE_RADIAL"}, "camera_model is SIMPLE_RADIAL"),
        ({"camera_model": ["PINHOLE"]}, "camera_model is .'PINHOLE'."),
        ({"camera_model": "PINHOLE", "k1": 0.1}, "PINHOLE with k1 = 0.1"),
        ({"k4": 0.1}, "nerfstudio and OpenCV mean different things by k4"),
        ({"camera_model": "OPENCV_FISHEYE", "p1": 0.1}, "OPENCV_FISHEYE with p1 = 0.1"),
        ({"fl_x": None, "fl_y": None}, "neither fl_x nor camera_angle_x"),
        ({"fl_x": None, "fl_y": None, "camera_angle_y": 4.0}, "camera_angle_y is 4"),
        ({"fl_x": -61.0}, "fx -61"),
        ({"fl_x": "wide"}, "fl_x is 'wide'"),
        ({"cx": math.nan}, "cx is nan"),
        ({"w": 64.5}, "w = 64.5"),
        ({"h": None}, "h is None"),
        ({"ply_file_path": "gone.ply"}, r"no file .*gone\.ply"),
        ({"depth_unit_scale_factor": 0}, "depth_unit_scale_factor is 0"),
        ({"train_filenames": ["images/frame_0001.png"]}, r"train_filenames names .*Did you mean"),
        ({"train_filenames": "all"}, "train_filenames is not a list"),
        ({"depth_estimated_from": ["images/frame_1.png"]}, r"depth_estimated_from names .*Did you mean"),
        (
            {"train_filenames": ["images/frame_00001.png"], "test_filenames": ["images/frame_00001.png"]},
            "is in train_filenames and test_filenames",
        ),
        ({"applied_transform": [[2, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0]]}, "applied_transform"),
    ],
)
def test_what_the_file_may_not_say(folder, content, message):
    with pytest.raises(InputError, match=message):
        opened(changed(folder, **content))


@pytest.mark.parametrize(
    ("write_bad", "message"),
    [
        (lambda path: np.save(path, np.zeros((HEIGHT, WIDTH, 3))), r"an array \[48, 64, 3\] of float64"),
        (lambda path: np.save(path, np.zeros((HEIGHT, WIDTH), complex)), "complex128"),
        (lambda path: np.save(path, np.array([None, {}])), "cannot read"),
        (lambda path: path.write_bytes(path.read_bytes()[:300]), "cannot read"),
        (lambda path: path.write_bytes(b""), "cannot read"),
    ],
)
def test_depth_arrays_of_another_kind(tmp_path, write_bad, message):
    write(tmp_path, frame_keys=depth_files(tmp_path, 1.0, ".npy"))
    write_bad(tmp_path / "depth/3.npy")
    with pytest.raises(InputError, match=message):
        load(tmp_path)


def test_images_of_two_sizes(folder):
    cv2.imwrite(str(folder / "images/frame_00004.png"), np.zeros((24, 32, 3), np.uint8))
    with pytest.raises(InputError, match=r"frame_00004\.png is 32 x 24"):
        load(changed(folder, w=None, h=None))


def test_neither_depth_nor_points(folder):
    (folder / "points3D.ply").unlink()
    with pytest.raises(InputError, match=r"neither depth files nor points3D\.ply.*initial_points=file"):
        load(folder)


# The phantom's layout


@pytest.mark.thorough
def test_the_phantom_is_the_one_of_the_pinhole_that_its_images_are_undistorted_to(tmp_path):
    bent, plain = (read(write_phantom(tmp_path / name, name, noise=0.0), name) for name in ("nerfstudio", "c3vd"))
    assert bent.provenance["lens"] == "OpenCVLens"
    for one, other in zip(in_video_order(bent), in_video_order(plain), strict=True):
        assert astuple(one.camera.intrinsics) == pytest.approx(astuple(other.camera.intrinsics))
        assert one.mask is None
        # The nearest source pixel is up to half a pixel away, which matters where the wall slants.
        gap = (one.depth - other.depth).abs() / other.depth
        assert gap.nanmedian() < 0.01
        # A slightly different image asks for a slightly different exposure.
        exposure = other.rgb.mean() / one.rgb.mean()
        assert (exposure * one.rgb - other.rgb).abs().mean() < 4 / 255


# The real sequence


def test_the_real_sequence_opens_with_the_poses_and_the_lens_of_its_other_file(shared_data):
    folder = shared_data / "c3vd_cecum_t1_a"
    assert find_format(folder) == "nerfstudio"
    recording = opened(folder, pixel_centers="integer")
    data = json.loads((folder / "frames.json").read_text())
    assert len(recording.shots) == 276
    for shot, frame in zip(recording.shots, data["frames"], strict=True):
        assert shot.image.name == frame["file_path"]
        np.testing.assert_allclose(shot.camera_to_world, frame["c2w"], atol=1e-12)
    rectification = recording.shots[0].rectification
    assert rectification.lens == real_lens(shared_data)
    assert (rectification.width, rectification.height) == (270, 270)
    undistortion = Undistortion(real_lens(shared_data), rectification.pinhole)
    image = read_rgb(recording.shots[100].image)
    np.testing.assert_array_equal(rectification.image(image), undistortion.image(image))
    assert rectification.valid is None


def test_the_real_sequence_loads_once_it_has_points(shared_data, tmp_path):
    folder = shared_data / "c3vd_cecum_t1_a"
    with pytest.raises(InputError, match="neither depth files nor"):
        load(folder, max_frames=2, split="all-train")
    points = np.load(shared_data / "c3vd_sparse_depth/cecum_t1_a_0000.npz")["points_world_mm"]
    np.savez(tmp_path / "points.npz", positions=points)
    scene = load(folder, initial_points="file", points_file=str(tmp_path / "points.npz"), frame_step=40)
    assert [frame.index for frame in scene.train] == [40, 80, 120, 160, 200, 240]
    camera = scene.test_sets["test"][0].camera
    pixels, depth = camera.project(scene.points.positions)
    # 8,192 points that frame 0 shows, most of them within its crop and its undistorted view.
    inside = (depth > 0) & (pixels >= 0).all(dim=1) & (pixels < 270).all(dim=1)
    assert inside.float().mean() > 0.5
