"""Particular to TUM's RGB-D layout: association by time or order, scales of depth, Gaussian Pancakes, EndoMapper."""

from __future__ import annotations

import json
from functools import partial

import cv2
import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from coliags_plugin.core.errors import InputError
from coliags_plugin.core.scenes import Frame
from coliags_plugin.engine.data_formats import find_format, recognised
from coliags_plugin.geometry.lenses.vicalib import read_calibration
from coliags_plugin.geometry.poses import tum
from coliags_plugin.geometry.poses.alignment import nearest_in_time
from coliags_plugin.geometry.poses.trajectory import Trajectory
from tests.datamanagers.kinds import change_lines, edit, files, with_intrinsics
from tests.datamanagers.wall_scenes import (
    FRAMES,
    HEIGHT,
    PINHOLE,
    WIDTH,
    layout_of,
    load_scene,
    look,
    manager,
    names,
    poses,
    rays,
)
from tests.datamanagers.wall_scenes import seen_from as expected_from

#: Steps per mm of the layout's depth.
SCALE = 500.0
START = 1305031102.0

KIND = "rgbd"  # by time
load = partial(load_scene, "rgbd")


def stamps(times: list[float]) -> list[str]:
    return [f"{time:.6f}" for time in times]


TIMES = [START + index / 30 for index in range(FRAMES)]


@pytest.fixture
def numbered(copied):
    return copied("rgbd-by-order")


def assert_right(frames: list[Frame], indices: list[int]) -> None:
    """Frames are those of the wall of these indices, each with its own pose, image and depth."""
    for frame, index in zip(frames, indices, strict=True):
        pose = poses(FRAMES)[index]
        np.testing.assert_allclose(frame.camera.camera_to_world, pose, atol=1e-5)
        depth, color = expected_from(frame, pose)
        np.testing.assert_array_equal(frame.image, color)
        assert frame.depth is None or np.abs(frame.depth.numpy() - depth).max() < 0.0011


def test_a_wall_is_written_as_tum_names_things(walls):
    folder = walls("rgbd")
    listed = (folder / "rgb.txt").read_text().splitlines()[1:]
    assert listed[0] == "1305031102.000000 rgb/1305031102.000000.png"
    assert all((folder / line.split()[1]).is_file() for line in listed)


# By time


def test_times_are_associated(walls):
    scene = load(walls("rgbd"))
    assert names(scene.video) == stamps(TIMES)
    facts = {"by": "time", "without_pose": 0, "without_depth": 0, "largest_difference_s": 0.0}
    assert scene.provenance.association == facts and scene.provenance.depth_scale == SCALE
    assert load(walls("rgbd-by-order")).provenance.association == {"by": "order"}


def test_clocks_that_nearly_agree_and_times_in_the_order_of_numbers(mine):
    times = np.arange(FRAMES) / 2 + 8.5
    stems = [f"{time:.3f}" for time in times]
    for part, early in (("rgb", 0.0), ("depth", 0.008)):
        for path, time in zip(files(mine, f"{part}/*.png"), times, strict=True):
            path.rename(path.with_name(f"{time - early:.3f}.png"))
    tum.write(mine / "groundtruth.txt", Trajectory(poses(FRAMES), timestamps=times + 0.009))
    scene = load(mine)
    assert names(scene.video) == stems != sorted(stems)
    assert_right(scene.video, [*range(FRAMES)])
    assert scene.provenance.association["largest_difference_s"] == pytest.approx(0.009, abs=1e-6)


def test_images_without_a_pose_or_depth_are_left_out_and_counted(mine, caplog):
    change_lines("groundtruth.txt", lambda rows: [*rows[:3], *rows[4:-1]])(mine)
    files(mine, "depth/*.png")[4].unlink()
    scene = load(mine)
    indices = [index for index in range(FRAMES) if index not in (2, 4, 10)]
    assert names(scene.video) == [stamps(TIMES)[index] for index in indices]
    assert_right(scene.video, indices)
    assert scene.provenance.association["without_pose"] == 2
    assert scene.provenance.association["without_depth"] == 1
    assert "of 11 images 2 have no pose and 1 no depth" in caplog.text
    for stamp in {*stamps(TIMES)} - {*names(scene.video)}:
        (mine / f"rgb/{stamp}.png").unlink()
    fewer = load(mine)
    assert names(fewer.video) == names(scene.video)
    # Seen masks are numbered by image and would now be those of others.
    assert all(frame.seen is None for frame in (*scene.video, *fewer.video))


def test_a_name_that_is_no_time(numbered):
    (numbered / "rgb/3.png").rename(numbered / "rgb/three.png")
    with pytest.raises(InputError, match=r"three.png: its name is not a timestamp"):
        load(numbered, association="time")


@given(
    st.lists(st.integers(0, 60), min_size=1, max_size=12, unique=True),
    st.lists(st.integers(0, 60), min_size=1, max_size=12, unique=True),
    st.integers(0, 5),
)
@settings(max_examples=60, deadline=None)
def test_nearest_in_time(wanted, known, tolerance):
    wanted, known = np.array(wanted, float), np.array(known, float)
    partner = nearest_in_time(wanted, known, tolerance)
    matched = partner >= 0
    assert len(set(partner[matched])) == matched.sum()
    assert (np.abs(wanted[matched] - known[partner[matched]]) <= tolerance).all()
    # Whoever went without had nothing nearer than what its candidates got.
    for index in np.flatnonzero(~matched):
        for candidate in np.flatnonzero(np.abs(known - wanted[index]) <= tolerance):
            (owner,) = np.flatnonzero(partner == candidate)
            assert abs(wanted[owner] - known[candidate]) <= abs(wanted[index] - known[candidate])


# By order


def test_whole_numbers_can_be_times(numbered):
    change_lines("groundtruth.txt", lambda rows: [*rows[:5], *rows[6:]])(numbered)
    with pytest.raises(InputError, match=r"groundtruth.txt has 10 poses for 11 images.*association=time"):
        load(numbered)
    indices = [index for index in range(FRAMES) if index != 5]
    scene = load(numbered, association="time")
    assert names(scene.video) == [str(index) for index in indices]
    assert_right(scene.video, indices)
    # A pose and another image lost: as many poses as images, but not of the same frames.
    for part in ("rgb", "depth"):
        (numbered / part / "7.png").unlink()
    assert len(load(numbered, association="order").video) == 10
    assert_right(load(numbered, association="time").video, [index for index in indices if index != 7])


# Depth, cameras and points


def test_scales_of_depth(mine):
    with pytest.raises(InputError, match=r"depth_scale = 500, but the option depth_scale is 5000"):
        load(mine, depth_scale=5000.0)
    assert load(mine, depth_scale=SCALE).provenance.depth_scale == SCALE


def test_a_trajectory_may_be_named(mine):
    (mine / "slam").mkdir()
    (mine / "groundtruth.txt").rename(mine / "slam/estimate.txt")
    assert len(load(mine, trajectory="slam/estimate.txt").train) == 9
    with pytest.raises(InputError, match=r"no file .*slam/other.txt"):
        load(mine, trajectory="slam/other.txt")


def test_other_files_do_not_make_it_a_scene(mine):
    recognise = manager("rgbd").recognise
    assert recognise(mine) == "the TUM trajectory groundtruth.txt beside rgb/"
    (mine / "groundtruth.txt").write_text("1,0,0,0,0,1,0,0,0,0,1,0,0,0,0,1\n")
    assert [recognise(path) for path in (mine, mine / "rgb", mine / "camera.json")] == [None] * 3


@pytest.mark.parametrize("form", ["{0} {1} {2} {3}\n", "{0}, {1}, {2}, {3}", "{0} 0 {2}\n0 {1} {3}\n0 0 1\n"])
def test_intrinsics_may_be_in_a_text_file(mine, form):
    k = json.loads((mine / "camera.json").read_text())
    with_intrinsics(form.format(*(k[key] for key in ("fx", "fy", "cx", "cy"))))(mine)
    scene = load(mine, depth_scale=SCALE)
    assert_right(scene.video, [*range(FRAMES)])
    assert scene.provenance.intrinsics_from == "intrinsics.txt"


@pytest.fixture
def pancakes(tmp_path):
    """Gaussian Pancakes' folder: relative depth, poses by order, COLMAP's camera, a mesh for the first points."""
    for index, pose in enumerate(poses(FRAMES)):
        depth, color = look(pose, rays(PINHOLE))
        for part, name, pixels in (
            ("images", f"{index}_color.jpg", color[..., ::-1]),
            ("depths", f"{index}_depth.png", np.rint(depth * SCALE).astype(np.uint16)),
        ):
            (tmp_path / part).mkdir(exist_ok=True)
            cv2.imwrite(str(tmp_path / part / name), pixels)
    tum.write(tmp_path / "rnnslam_poses.txt", Trajectory(poses(FRAMES), timestamps=np.arange(float(FRAMES))))
    k = PINHOLE
    (tmp_path / "cameras.txt").write_text(f"# Cameras\n1 PINHOLE 64 48 {k.fx} {k.fy} {k.cx} {k.cy}\n")
    (tmp_path / "mesh.obj").write_text("# v\nv 1 2 40 1.0 0.5 0\nv -1.5 0 41 0 0 1\nvt 0 0\nf 1/1 2/1 1/1\n")
    return tmp_path


def test_gaussian_pancakes_folder(pancakes):
    assert find_format(pancakes) == "rgbd"
    scene = load(pancakes, depth="none")
    frames = scene.video
    assert names(frames) == [f"{index}_color" for index in range(FRAMES)]
    assert all(frame.depth is None for frame in frames)
    np.testing.assert_allclose(frames[10].camera.camera_to_world, poses(FRAMES)[10], atol=1e-6)
    assert frames[0].camera.intrinsics == PINHOLE
    assert scene.points.positions.tolist() == [[1.0, 2.0, 40.0], [-1.5, 0.0, 41.0]]
    assert scene.points.colors.tolist() == [[255, 128, 0], [0, 0, 255]]
    assert scene.provenance.points.source == "mesh.obj"
    with pytest.raises(InputError, match=r"or `datamanager.depth=none` if it is relative"):
        load(pancakes)
    frame = load(pancakes, depth_scale=SCALE).train[0]
    assert np.abs(frame.depth.numpy() - expected_from(frame, poses(FRAMES)[1])[0]).max() < 0.0011
    ply = "ply\nformat ascii 1.0\nelement vertex 1\n" + "".join(f"property float {axis}\n" for axis in "xyz")
    (pancakes / "points3D.ply").write_text(f"{ply}end_header\n3 4 5\n")
    assert load(pancakes, depth="none").points.positions.tolist() == [[3.0, 4.0, 5.0]]
    (pancakes / "cameras.txt").write_text("1 SIMPLE_PINHOLE 64 48 60 32 24\n")
    camera = load(pancakes, depth="none").train[0].camera
    assert (camera.fx, camera.fy, camera.cx, camera.cy) == (60.0, 60.0, 32.0, 24.0)


@pytest.mark.parametrize(
    ("name", "text", "message"),
    [
        ("mesh.obj", "v 1 2 3 0 0 1\nv 1 2", "mesh.obj has vertices that are not rows of numbers"),
        ("cameras.txt", "1 OPENCV 64 48 60 60 32 24 0.1 0 0 0", r"the camera is OPENCV.*Undistort"),
        ("cameras.txt", "1 PINHOLE 64 48 60 60 32", r"'1 PINHOLE 64 48 60 60 32'"),
        ("cameras.txt", "1 PINHOLE 64 48 sixty 60 32 24", r"'1 PINHOLE 64 48 sixty"),
        ("cameras.txt", "1 PINHOLE 64 48 60 60 32 24\n2 PINHOLE 64 48 60 60 32 24", r"has 2 cameras"),
        ("cameras.txt", "# nothing", r"has 0 cameras"),
    ],
)
def test_files_of_gaussian_pancakes_that_do_not_do(pancakes, name, text, message):
    (pancakes / name).write_text(text + "\n")
    with pytest.raises(InputError, match=message):
        load(pancakes, depth="none")


# EndoMapper: its calibration, against OpenCV's fisheye, and which folders are its


load_endomapper = partial(load_scene, "endomapper")


@pytest.fixture
def endomapper(copied):
    return copied("endomapper")


def stored_pixels(camera, folder) -> np.ndarray:
    """Column and row of the stored pixel behind every working pixel, by OpenCV's fisheye. [H, W, 2]"""
    lens, k = read_calibration(folder / "calibration.xml").lens, camera.intrinsics
    column, row = np.meshgrid(np.arange(k.width) + 0.5, np.arange(k.height) + 0.5)
    rays = np.stack([(column - k.cx) / k.fx, (row - k.cy) / k.fy, np.ones_like(column)], axis=-1)
    matrix = np.array([[lens.fx, 0.0, lens.cx], [0.0, lens.fy, lens.cy], [0.0, 0.0, 1.0]])
    terms = np.array([lens.k1, lens.k2, lens.k3, lens.k4])
    pixels, _ = cv2.fisheye.projectPoints(rays.reshape(-1, 1, 3), np.zeros(3), np.zeros(3), matrix, terms)
    return np.floor(pixels).astype(int).reshape(*column.shape, 2)


def test_depth_is_read_to_the_bit(walls):
    folder = walls("endomapper")
    scene = load_endomapper(folder)
    calibration, written = read_calibration(folder / "calibration.xml"), layout_of("endomapper").lens(WIDTH, HEIGHT)[0]
    points = np.random.default_rng(0).uniform((-0.8, -0.6, 1.0), (0.8, 0.6, 1.0), (50, 3))
    np.testing.assert_allclose(calibration.lens.project(points), written.project(points), atol=1e-12)
    pixels = stored_pixels(scene.train[0].camera, folder)
    for frame in scene.video[::4]:
        steps = cv2.imread(str(folder / f"depth/{frame.name}.png"), cv2.IMREAD_UNCHANGED)
        expected = (steps[pixels[..., 1], pixels[..., 0]] / calibration.depth_scale).astype(np.float32)
        np.testing.assert_array_equal(frame.depth, np.where(expected == 0.0, np.nan, expected))
    assert scene.provenance.lens == "FisheyeLens"
    assert scene.provenance.intrinsics_from == "calibration.xml"


def test_another_camera_file_makes_it_an_rgbd_folder(endomapper):
    assert recognised(endomapper) == {"endomapper": "the TUM trajectory trajectory.txt beside rgb/"}
    (endomapper / "intrinsics.txt").write_text("20 20 19.5 15.5")
    assert list(recognised(endomapper)) == ["rgbd"]
    (endomapper / "calibration.xml").unlink()
    (endomapper / "intrinsics.txt").unlink()
    assert find_format(endomapper) == "rgbd"


def test_the_scale_of_depth_is_that_of_the_file_or_the_option(endomapper):
    before = load_endomapper(endomapper).train[0].depth
    edit("calibration.xml", "500.0", "250.0")(endomapper)
    torch.testing.assert_close(load_endomapper(endomapper).train[0].depth, 2.0 * before, equal_nan=True)
    edit("calibration.xml", "<depth_scale.*", "")(endomapper)
    torch.testing.assert_close(
        load_endomapper(endomapper, depth_scale=250.0).train[0].depth, 2.0 * before, equal_nan=True
    )
    assert load_endomapper(endomapper, depth="none", initial_points="none").train[0].depth is None
