"""Particular to nerfstudio: cameras, the change of its world, its split, units of depth, a real sequence."""

from __future__ import annotations

import json
import math
import shutil
from dataclasses import astuple, replace
from functools import partial
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch

from coliags_plugin.core.errors import InputError
from coliags_plugin.core.images import read_rgb
from coliags_plugin.core.ply import point_properties, write_ply
from coliags_plugin.core.scenes import TO_GET_DEPTH
from coliags_plugin.datamanagers.recorded import Recording
from coliags_plugin.geometry.lenses.models import FisheyeLens, Lens, OpenCVLens
from coliags_plugin.geometry.poses.trajectory import FLIP_Y_AND_Z
from tests.datamanagers.kinds import change_frames, change_json
from tests.datamanagers.wall_scenes import PINHOLE, load_scene, look, manager, off_wall, poses, rays, seen_from

WIDTH, HEIGHT, COUNT = 64, 48, 9
SIZE = vars(PINHOLE)
BROWN = {"k1": -0.15, "k2": 0.03, "k3": 0.004, "p1": 0.003, "p2": -0.004}
FISHEYE = {"k1": -0.05, "k2": 0.01, "k3": 0.003, "k4": -0.001}
#: The file's keys, pixel centres at integers + 0.5.
CAMERA = {"fl_x": PINHOLE.fx, "fl_y": PINHOLE.fy, "cx": PINHOLE.cx, "cy": PINHOLE.cy, "w": WIDTH, "h": HEIGHT}
NAMES = [f"images/frame_{index + 1:05d}.png" for index in range(COUNT)]
FILE = "transforms.json"

load = partial(load_scene, "nerfstudio")


def opened(folder: Path, **options) -> Recording:
    return manager("nerfstudio", **options).open(folder)


def write(folder: Path, lens: Lens | None = None, names: list[str] = NAMES, **content) -> Path:
    """The tilted wall, in millimetres, with points3D.ply beside it; ``content`` goes into the file, None out of it."""
    frames, directions = [], rays(lens or PINHOLE)
    for name, pose in zip(names, poses(len(names)), strict=True):
        depth, color = look(pose, directions)
        path = folder / (name if Path(name).suffix else f"{name}.png")
        path.parent.mkdir(parents=True, exist_ok=True)
        cv2.imwrite(str(path), color[..., ::-1])
        frames.append({"file_path": name, "transform_matrix": (pose @ FLIP_Y_AND_Z).tolist()})
    points = pose[:3, 3] + depth.reshape(-1, 1) * directions.reshape(-1, 3) @ pose[:3, :3].T
    write_ply(folder / "points3D.ply", point_properties(points, np.full(points.shape, 128, np.uint8)))
    content = {"camera_model": "OPENCV", **CAMERA, "frames": frames, **content}
    (folder / FILE).write_text(json.dumps({key: value for key, value in content.items() if value is not None}))
    return folder


@pytest.fixture(scope="module")
def wall(tmp_path_factory) -> Path:
    return write(tmp_path_factory.mktemp("nerfstudio") / "wall")


@pytest.fixture
def mine(wall, tmp_path) -> Path:
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
        # instant-ngp's word for it
        (None, {"is_fisheye": True, **FISHEYE}, FisheyeLens(**SIZE, **FISHEYE)),
    ],
)
def test_images_of_every_camera_become_pinhole_images(tmp_path, model, bends, lens):
    for frame in load(write(tmp_path, lens, NAMES[:3], camera_model=model, **bends)).video:
        assert vars(frame.camera.intrinsics) == vars(PINHOLE)
        _, color = seen_from(frame, poses(3)[frame.index])
        off = np.abs(color.astype(int) - frame.image.numpy())[frame.valid.numpy()]
        assert off.max() == 0 if lens is None else np.mean(off) < 0.6 and np.quantile(off, 0.999) <= 4
        assert frame.valid.float().mean() > 0.75


def test_a_frames_own_camera_goes_before_the_files(mine):
    change_frames(FILE, lambda index, entry: entry.update({"fl_x": 70.0, "k1": -0.1} if index == 3 else {}))(mine)
    shots = opened(mine).shots
    assert [shot.rectification.pinhole.fx for shot in shots] == [61.0, 61.0, 61.0, 70.0, *[61.0] * 5]
    assert len({id(shot.rectification) for shot in shots}) == 2


@pytest.mark.parametrize("axis", ["x", "y"])
def test_an_angle_of_view_stands_for_a_focal_length(mine, axis):
    angle = {f"camera_angle_{axis}": 2.0 * math.atan(0.5 * (WIDTH if axis == "x" else HEIGHT) / 61.0)}
    change_json(FILE, **dict.fromkeys(CAMERA), **angle)(mine)
    pinhole = opened(mine).shots[0].rectification.pinhole
    assert astuple(pinhole) == pytest.approx((61.0, 61.0, 32.0, 24.0, WIDTH, HEIGHT))


def test_where_pixel_centres_are_counted(wall):
    half, whole = (opened(wall, pixel_centers=kind).shots[0].rectification.pinhole for kind in ("half", "integer"))
    assert half == PINHOLE
    assert whole == replace(PINHOLE, cx=PINHOLE.cx + 0.5, cy=PINHOLE.cy + 0.5)


# Poses and files


def test_nerfstudios_change_of_the_world_is_undone_for_poses_and_points(wall, mine):
    applied = np.array([[0.0, 1.0, 0.0, 3.0], [1.0, 0.0, 0.0, -2.0], [0.0, 0.0, -1.0, 5.0]])

    def move(index: int, entry: dict) -> None:
        moved = np.vstack([applied, [0, 0, 0, 1]]) @ np.array(entry["transform_matrix"])
        moved[:3, 3] *= 0.5
        entry["transform_matrix"] = moved.tolist()

    change_frames(FILE, move)(mine)
    points = load(wall).points.positions.double().numpy()
    moved_points = 0.5 * (points @ applied[:, :3].T + applied[:, 3])
    write_ply(mine / "sparse_pc.ply", point_properties(moved_points, np.zeros(points.shape, np.uint8)))
    change_json(FILE, applied_transform=applied.tolist(), applied_scale=0.5, ply_file_path="sparse_pc.ply")(mine)
    before, after = load(wall), load(mine)
    for first, other in zip(before.train, after.train, strict=True):
        torch.testing.assert_close(first.camera.camera_to_world, other.camera.camera_to_world, atol=1e-5, rtol=0)
    assert off_wall(after.points.positions.numpy()).max() < 1e-3
    assert any("undone" in remark for remark in after.provenance.pose_convention["remarks"])


NGP, UNREAD, DEFAULT = {"integer_depth_scale": 0.02}, "no depth is read from depth_path", "0.001 units a step"


@pytest.mark.parametrize(
    ("key", "said", "options", "factor", "warning"),
    [
        ("depth_file_path", {}, {"unit": "unknown"}, 0.1, DEFAULT),
        ("depth_file_path", {}, {"unit": "unknown", "scale": 3.0}, 0.3, DEFAULT),
        ("depth_file_path", {"depth_unit_scale_factor": 0.02}, {"unit": "unknown", "scale": 3.0}, 6.0, ""),
        ("depth_file_path", {}, {"unit": "mm"}, 100.0, ""),
        ("depth_file_path", {}, {"unit": "m"}, 100.0, ""),
        ("depth_file_path", {"depth_unit_scale_factor": 0.02}, {"depth_unit_scale_factor": 0.05}, 5.0, ""),
        ("depth_path", NGP, {"unit": "unknown"}, 2.0, ""),
        (
            "depth_path",
            NGP | {"scale": 0.33, "offset": [1, 2, 3], "enable_depth_loading": True},
            {"scale": 3.0},
            6.0,
            "",
        ),
        ("depth_path", NGP | {"applied_scale": 0.5}, {}, 4.0, ""),
        ("depth_path", {}, {"depth_unit_scale_factor": 0.05}, 5.0, ""),
        ("depth_path", NGP | {"enable_depth_loading": False}, {}, None, UNREAD),
        ("depth_path", {"enable_depth_loading": True}, {}, None, UNREAD),
        ("depth_path", {"integer_depth_scale": -1.0}, {}, None, UNREAD),
        ("sensor_depth_path", NGP, {}, None, "no depth is read from sensor_depth_path"),
    ],
)
def test_depth_files_of_other_writers(walls, copied, caplog, key, said, options, factor, warning):
    def rename(_, frame):
        frame[key] = frame.pop("depth_file_path")

    folder, expected = copied("nerfstudio"), load(walls("nerfstudio")).train[1].depth
    change_frames(FILE, rename)(folder)
    change_json(FILE, **{"depth_unit_scale_factor": None, **said})(folder)
    read = load(folder, initial_points="none", **options).train[1].depth
    assert warning in caplog.text and bool(warning) == bool(caplog.records)
    assert (read is None) == (factor is None)
    if factor is not None:
        torch.testing.assert_close(read, factor * expected, equal_nan=True)


@pytest.mark.parametrize("change", [{"mask_path": "m.png"}, {"masks": "masks/"}])
@pytest.mark.parametrize("of_frames", [False, True])
def test_masks_under_another_key_are_named(mine, caplog, change, of_frames):
    if of_frames:
        change = {f"{key}_1": value for key, value in change.items()}
        change_frames(FILE, lambda index, entry: entry.update(change if index == 3 else {}))(mine)
    else:
        change_json(FILE, **change)(mine)
    load(mine)
    assert f"masks are the mask_path of a frame; ignored: {next(iter(change))}" in caplog.text


def test_masks_of_instant_ngp_are_named(mine, caplog):
    for index in (1, 2):  # not black = ignored
        cv2.imwrite(str(mine / f"images/dynamic_mask_frame_0000{index}.png"), np.zeros((HEIGHT, WIDTH), np.uint8))
    load(mine)
    assert "images/dynamic_mask_frame_00001.png, images/dynamic_mask_frame_00002.png not used: format" in caplog.text


def test_masks_of_some_frames(mine):
    mask = np.full((HEIGHT, WIDTH), 255, np.uint8)
    mask[5:20, 3:9] = 0
    cv2.imwrite(str(mine / "mask.png"), mask)
    change_frames(FILE, lambda index, entry: entry.update({"mask_path": "mask.png"} if index % 2 else {}))(mine)
    for frame in load(mine).video:
        if frame.index % 2:
            np.testing.assert_array_equal(frame.mask.numpy(), mask > 0)
        else:
            assert frame.mask is None


def test_the_files_own_split(mine):
    change_json(FILE, train_filenames=["./" + name for name in NAMES[:5]], val_filenames=NAMES[5:7])(mine)
    scene = load(mine, split="own")
    assert [frame.index for frame in scene.train] == [0, 1, 2, 3, 4]
    assert [frame.index for frame in scene.test_sets["test"]] == [5, 6]
    change_json(FILE, test_filenames=NAMES[7:])(mine)
    assert [frame.index for frame in load(mine, split="own").test_sets["test"]] == [7, 8]
    assert [frame.index for frame in load(mine).test_sets["test"]] == [0, 8]


@pytest.mark.parametrize("start", ["{folder}", ".."])
def test_a_scene_whose_images_lie_elsewhere_has_to_be_trusted(mine, tmp_path, start):
    shutil.move(mine / "images", tmp_path / "elsewhere")
    place = start.format(folder=tmp_path)
    change_frames(FILE, lambda _, entry: entry.update(file_path=f"{place}/elsewhere/{entry['file_path'][7:]}"))(mine)
    with pytest.raises(InputError, match="outside_files=true"):
        load(mine)
    assert len(load(mine, outside_files=True).train) == 7


# The real sequence


def test_the_real_sequence_loads_once_it_has_points(shared_data, tmp_path):
    folder = shared_data / "c3vd_cecum_t1_a"
    with pytest.raises(InputError, match=f"neither depth files nor .*{TO_GET_DEPTH}"):
        load(folder, max_frames=2, split="all-train")
    data = np.load(shared_data / "c3vd_sparse_depth/cecum_t1_a_0000.npz")
    np.savez(tmp_path / "points.npz", positions=data["points_world_mm"])
    options = {"points_file": str(tmp_path / "points.npz"), "pixel_centers": "integer", "frame_step": 40}
    scene = load(folder, initial_points="file", **options)
    assert [frame.index for frame in scene.train] == [40, 80, 120, 160, 200, 240]
    # Ground-truth points of frame 0 project where the lens and the undistortion put them.
    frame = scene.test_sets["test"][0]
    pixels, depth = frame.camera.to(dtype=torch.float64).project(torch.from_numpy(data["points_world_mm"]).double())
    np.testing.assert_allclose(depth, data["depth_mm"], atol=2e-4)
    source = (data["uv_raw1350x1080"] - (275, 140)).astype(np.float32)
    inside = ((pixels > 3) & (pixels < 267)).all(dim=1).numpy() & ((source > 3) & (source < 797)).all(axis=1)
    assert inside.sum() > 2000
    # Colours of the undistorted image there, against those of the distorted one where the points were seen.
    smooth, places = cv2.blur(read_rgb(folder / "0000_color_crop800.jpg"), (3, 3)), source[inside]
    expected = cv2.remap(smooth, places[None, :, 0], places[None, :, 1], cv2.INTER_LINEAR)[0].astype(float)
    target, image = (pixels[inside].numpy() - 0.5).astype(np.float32), frame.image.numpy()

    def difference(shift: float) -> float:
        shades = cv2.remap(image, target[None, :, 0] + shift, target[None, :, 1], cv2.INTER_LINEAR)[0]
        return np.abs(shades.astype(float) - expected).mean()

    # A quarter of a pixel shows, to either side.
    assert difference(0.0) < 1.5
    assert difference(0.0) < 0.9 * min(difference(0.25), difference(-0.25))
