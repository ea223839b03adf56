"""Readers against hand-made files, by definition, and against pycolmap; refusals that name the place."""

from __future__ import annotations

import json
import re
from dataclasses import astuple
from unittest import mock

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.interpolate import CubicSpline
from scipy.spatial.transform import Rotation

from coliags_plugin.core.errors import InputError
from coliags_plugin.datamanagers.file_formats import camera_of
from coliags_plugin.geometry.poses import colmap, nerfstudio, tum
from coliags_plugin.geometry.poses.c3vd import read_poses
from coliags_plugin.geometry.poses.formats import format_of
from coliags_plugin.geometry.poses.trajectory import (
    Trajectory,
    rigid,
    rotation_angles_deg,
    rotations_from_wxyz,
    wxyz_from_rotations,
)
from tests.commands import refuses
from tests.datamanagers.wall_scenes import poses
from tests.geometry.poses.winding import PINHOLE, as_text, some_transform, winding

#: A quarter turn about z: x to the right becomes y. Written out, so that no library decides what is right.
QUARTER = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
HALF = np.sqrt(0.5)


@given(st.lists(st.floats(-10, 10), min_size=4, max_size=4))
@settings(max_examples=50, deadline=None)
def test_quaternions_by_the_formula(numbers):
    quat = np.array(numbers)
    if np.linalg.norm(quat) < 1e-3:
        return
    w, x, y, z = quat / np.linalg.norm(quat)
    formula = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    rotation = rotations_from_wxyz(quat[None], str, unit=False)
    np.testing.assert_allclose(rotation[0], formula, atol=1e-12)
    back = wxyz_from_rotations(rotation)[0]
    assert back[0] >= 0.0
    assert min(np.abs(back - sign * quat / np.linalg.norm(quat)).max() for sign in (1, -1)) < 1e-7


def test_what_is_no_rotation_is_refused_and_small_angles_are_exact():
    for quat in ([0, 0, 0, 0], [1e-12, 0, 0, 0], [np.nan, 0, 0, 1], [np.inf, 0, 0, 0]):
        with pytest.raises(InputError, match=r"frame 1: the quaternion .* is not a rotation"):
            rotations_from_wxyz(np.array([[1, 0, 0, 0], quat], float), lambda index: f"frame {index}", unit=False)
    turn = Rotation.from_rotvec([[1e-7, 0, 0], [0, np.pi, 0]]).as_matrix()
    np.testing.assert_allclose(rotation_angles_deg(turn), np.rad2deg([1e-7, np.pi]), rtol=1e-6)


def test_tum_is_camera_to_world_with_w_last(tmp_path):
    (tmp_path / "poses").write_text(f"# a comment\n\n3.5 1 2 3 0 0 {HALF} {HALF}\n")
    read = tum.read(tmp_path / "poses")
    np.testing.assert_allclose(read.rotations[0], QUARTER, atol=1e-15)
    np.testing.assert_array_equal(read.centers[0], [1, 2, 3])
    assert read.timestamps.tolist() == [3.5]


COLUMNS = "timestamp tx ty tz qx qy qz qw"
W_FIRST = COLUMNS.replace("qx qy qz qw", "qw qx qy qz")


@pytest.mark.parametrize("comment", ["% made by hand\n", f"{COLUMNS}\n", ""])
@pytest.mark.parametrize("separator", [" ", ",", ", ", ";", "\t", "; "])
@pytest.mark.parametrize("encoding", ["utf-8", "utf-16"])
def test_tum_in_every_spelling(tmp_path, comment, separator, encoding):
    trajectory, path = winding(4, timestamps=np.arange(4) / 3), tmp_path / "poses.txt"
    tum.write(path, trajectory)
    rows = "".join(line for line in path.read_text().splitlines(keepends=True)[1:])
    path.write_bytes((comment.replace(" ", separator) + rows.replace(" ", separator)).encode(encoding))
    assert format_of(path).name == "tum"
    read = tum.read(path)
    np.testing.assert_allclose(read.camera_to_world, trajectory.camera_to_world, atol=1e-12)
    np.testing.assert_array_equal(read.timestamps, trajectory.timestamps)


def test_tum_almost(tmp_path):
    path = tmp_path / "poses.txt"
    for line, message in (
        ("0 0.5 1 2 3 0 0 0 1", "line 2: '0 0.5 1 2 3 0 0 0 1'. Expected 8 finite numbers"),
        ("0,5 1,0 2,0 3,0 0,0 0,0 0,0 1,0", "line 2: '0,5 1,0 .*with decimal points"),
        ("0,5;1,0;2,0;3,0;0,0;0,0;0,0;1,0", "line 2: '0,5;1,0;.*with decimal points"),
    ):
        path.write_text(f"# a comment\n{line}\n")
        refuses(message, tum.read, path)
        refuses(re.escape(f"'{line}'"), format_of, path)


def stored_w_first(path, trajectory, names=""):
    """A TUM file whose quaternions have w first."""
    tum.write(path, trajectory)
    rows = np.loadtxt(path)[:, [0, 1, 2, 3, 7, 4, 5, 6]]
    path.write_text(f"{names}\n{as_text(rows)}")
    return path


def smooth(seed: int, forward: bool, count: int = 40) -> Trajectory:
    """Cameras that turn about all axes from a random pose on, and drift, or fly along their own z axis."""
    rng, times = np.random.default_rng(seed), np.linspace(0.0, 1.0, count)
    turns = Rotation.random(random_state=seed) * Rotation.from_rotvec(
        CubicSpline(np.linspace(0, 1, 4), rng.normal(size=(4, 3)))(times)
    )
    steps = turns.as_matrix()[:, :, 2] if forward else CubicSpline(np.linspace(0, 1, 4), rng.normal(size=(4, 3)))(times)
    return Trajectory(rigid(turns.as_matrix(), np.cumsum(steps, axis=0)))


@pytest.mark.parametrize(
    "trajectory",
    [
        Trajectory(np.linalg.inv(winding(6).camera_to_world[0]) @ winding(6).camera_to_world),
        Trajectory(rigid(np.tile(np.eye(3), (4, 1, 1)), np.outer(np.arange(4.0), (1, 2, 3)))),
        *(smooth(seed, forward=True) for seed in (0, 1)),
    ],
)
def test_names_of_columns_may_put_w_first_which_is_suspected_where_it_explains_the_path(tmp_path, caplog, trajectory):
    path = stored_w_first(tmp_path / "poses.txt", trajectory)
    tum.read(path)
    assert "look as if w came first" in caplog.text and f"'# {W_FIRST}'" in caplog.text
    caplog.clear()
    euroc = "#timestamp [ns], p_x, q_RS_w [], q_RS_x [], q_RS_y [], q_RS_z []"
    for names in (f"# {W_FIRST}", W_FIRST.replace(" ", ","), euroc):
        read = tum.read(stored_w_first(path, trajectory, names))
        np.testing.assert_allclose(read.camera_to_world, trajectory.camera_to_world, atol=1e-12)
        assert "w first" in read.stored_as and not caplog.messages


@given(seed=st.integers(0, 2**31), forward=st.booleans(), count=st.sampled_from([1, 2, 3, 12, 60]))
@settings(max_examples=60, deadline=None)
def test_w_last_is_not_suspected(tmp_path_factory, seed, forward, count):
    path = tmp_path_factory.mktemp("tum") / "poses.txt"
    straight = Trajectory(rigid(np.tile(np.eye(3), (count, 1, 1)), np.arange(3.0 * count).reshape(count, 3)))
    for trajectory in (smooth(seed, forward, count), winding(count, seed), straight):
        tum.write(path, trajectory)
        with mock.patch.object(tum.log, "warning") as warning:
            tum.read(path)
        assert not warning.called


def transforms(path, matrices, names=None, frame=None, **content):
    frames = [
        {"file_path": names[index] if names else f"{index}.png", "transform_matrix": matrix.tolist(), **(frame or {})}
        for index, matrix in enumerate(matrices)
    ]
    path.write_text(json.dumps({**content, "frames": frames}))
    return path


def test_opengl_cameras_look_along_minus_z_and_hold_y_up(tmp_path):
    read = nerfstudio.read(transforms(tmp_path / "t.json", [some_transform(1)]))
    opengl = some_transform(1)
    np.testing.assert_array_equal(read.camera_to_world[0, :3, 2], -opengl[:3, 2])
    np.testing.assert_array_equal(read.camera_to_world[0, :3, 1], -opengl[:3, 1])
    np.testing.assert_array_equal(read.camera_to_world[0, :3, [0, 3]], opengl[:3, [0, 3]].T)
    three_rows = nerfstudio.read(transforms(tmp_path / "t.json", [opengl[:3]]))
    np.testing.assert_array_equal(three_rows.camera_to_world, read.camera_to_world)


def test_frames_are_ordered_as_people_count(tmp_path):
    names = ["10.png", "9.png", "frame2", "frame10", "1.png", "01.png", "frame"]
    matrices = [some_transform(seed) for seed in range(len(names))]
    read = nerfstudio.read(transforms(tmp_path / "t.json", matrices, names))
    assert read.names == ("01.png", "1.png", "9.png", "10.png", "frame", "frame2", "frame10")
    np.testing.assert_array_equal(read.centers, [matrices[names.index(name)][:3, 3] for name in read.names])
    assert any("order of their names" in remark for remark in read.remarks)


KEYS = {"fl_x": 100.0, "fl_y": 90.0, "cx": 31.0, "cy": 25.0, "w": 64, "h": 48}


@pytest.mark.parametrize(
    ("content", "frame", "expected", "remark"),
    [
        (KEYS, {}, (100, 90, 31, 25, 64, 48), None),
        (KEYS, {"fl_x": 50.0}, (50, 90, 31, 25, 64, 48), None),
        ({**KEYS, "camera_model": "OPENCV", "k1": 0.0}, {}, (100, 90, 31, 25, 64, 48), None),
        ({"camera_angle_x": np.pi / 2, "w": 64, "h": 48}, {}, (32, 32, 32, 24, 64, 48), None),
        ({**KEYS, "k1": 0.1}, {}, None, "distorted"),
        ({**KEYS, "camera_model": "OPENCV_FISHEYE"}, {}, None, "OPENCV_FISHEYE"),
        ({"fl_x": 100.0, "w": 64}, {}, None, "no fl_y, cx, cy, h"),
    ],
)
def test_intrinsics(tmp_path, content, frame, expected, remark):
    read = nerfstudio.read(transforms(tmp_path / "t.json", [some_transform(0)] * 2, frame=frame, **content))
    if expected is None:
        assert read.intrinsics is None and remark in read.remarks[-1]
    else:
        np.testing.assert_allclose(astuple(read.intrinsics), expected)
        assert not read.remarks
    if content is KEYS:
        changed = json.loads((tmp_path / "t.json").read_text())
        changed["frames"][1]["fl_x"] = 99.0
        (tmp_path / "t.json").write_text(json.dumps(changed))
        several = nerfstudio.read(tmp_path / "t.json").remarks
        assert several == ("no common pinhole: the images have 2 different cameras",)


FRAME = {"file_path": "a", "transform_matrix": np.eye(4).tolist()}


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ([1], "holds a JSON list"),
        ({"frames": [3]}, "frame 0: no file_path"),
        ({"frames": [{**FRAME, "transform_matrix": [[1, 2], [3]]}]}, "4 .or 3. rows of 4 finite numbers"),
        ({"frames": [FRAME], "applied_transform": "x"}, "applied_transform is not a matrix"),
        ({"frames": [FRAME], "applied_scale": 0}, "applied_scale is 0"),
        ({"frames": [FRAME], "applied_scale": True}, "applied_scale is True"),
        ({"frames": [FRAME], **KEYS, "w": 0}, "t.json: intrinsics .* image 0 x 48"),
    ],
)
def test_broken_transforms_are_refused(tmp_path, content, message):
    """Besides those of :data:`tests.datamanagers.kinds.SAID`."""
    (tmp_path / "t.json").write_text(json.dumps(content))
    refuses(message, nerfstudio.read, tmp_path / "t.json")


def write(path, matrices, separator=","):
    path.write_text("\n".join(separator.join(f"{n:.9g}" for n in np.ravel(m)) for m in matrices) + "\n")
    return path


@pytest.mark.parametrize("separator", [",", ", ", "\t"])
@pytest.mark.parametrize("order", ["column-major", "row-major"])
@pytest.mark.parametrize("from_origin", [False, True])
def test_order_is_found(tmp_path, order, separator, from_origin):
    expected = np.linalg.inv(poses(5)[0]) @ poses(5) if from_origin else poses(5)
    stored = expected.transpose(0, 2, 1) if order == "column-major" else expected
    read = read_poses(write(tmp_path / "pose.txt", stored, separator))
    assert read.convention == order
    np.testing.assert_allclose(read.camera_to_world, expected, atol=1e-7)
    assert json.dumps(read.evidence, allow_nan=False)
    larger, smaller = ("last_row", "last_column") if order == "column-major" else ("last_column", "last_row")
    assert read.evidence[f"largest_number_in_{larger}"] > 1.0
    assert read.evidence[f"largest_number_in_{smaller}"] == 0.0
    length = np.linalg.norm(np.diff(expected[:, :3, 3], axis=0), axis=1).sum()
    assert read.evidence["trajectory_length_mm"] == pytest.approx(length)
    assert read.evidence["mean_step_mm"] == pytest.approx(length / 4)


def test_without_translation_only_symmetric_rotations_can_be_read(tmp_path):
    still = poses(3)
    still[:, :3, 3] = 0.0
    refuses("row-major and column-major order cannot be distinguished", read_poses, write(tmp_path / "pose.txt", still))
    np.testing.assert_array_equal(read_poses(write(tmp_path / "one.txt", [np.eye(4)])).camera_to_world, [np.eye(4)])


def test_lines_of_another_order_or_length_are_refused(tmp_path):
    """Besides what :data:`tests.datamanagers.kinds.SAID` has."""
    stored = poses(5)
    stored[3] = stored[3].T
    for matrices, message in ((stored, "line 4: not a rigid transform"), (poses(5)[:, :3], "line 1: .*16 finite")):
        refuses(message, read_poses, write(tmp_path / "pose.txt", matrices))


ONE = "1 1 0 0 0 5 6 7 1 a.png\n\n"
CAMERA = "1 PINHOLE 64 48 70 71 32 24\n"
NAMES = ("10.png", "2.png", "frame.png", "sub/1.png")


def by_pycolmap(path):
    """Name -> camera-to-world, as pycolmap reads it."""
    import pycolmap

    result = {}
    for image in pycolmap.Reconstruction(str(path)).images.values():
        world_to_camera = np.eye(4)
        world_to_camera[:3] = image.cam_from_world().matrix()
        result[image.name] = np.linalg.inv(world_to_camera)
    return result


@pytest.mark.parametrize("text", [False, True])
def test_what_is_written_is_read_by_pycolmap_and_in_the_order_of_numbers(tmp_path, text):
    import pycolmap

    trajectory = winding(4, names=NAMES, intrinsics=PINHOLE)
    colmap.write(tmp_path / "model", trajectory, text=text)
    poses = by_pycolmap(tmp_path / "model")
    assert set(poses) == set(NAMES)
    for name, expected in zip(NAMES, trajectory.camera_to_world, strict=True):
        np.testing.assert_allclose(poses[name], expected, atol=1e-10)
    (camera,) = pycolmap.Reconstruction(str(tmp_path / "model")).cameras.values()
    assert (camera.model_name, camera.width, camera.height) == ("PINHOLE", 64, 48)
    np.testing.assert_array_equal(camera.params, [61.0, 55.0, 33.5, 21.5])
    read, order = colmap.read(tmp_path / "model"), [1, 0, 2, 3]  # numbers before words, 2 before 10
    assert read.names == tuple(NAMES[index] for index in order)
    np.testing.assert_allclose(read.camera_to_world, trajectory.camera_to_world[order], atol=1e-10)
    assert read.intrinsics == PINHOLE


def test_points_in_images_txt_may_be_missing_or_blank_but_keep_their_line(tmp_path):
    rows = ["1 1 0 0 0 5 6 7 1 b.png", "10.5 11 -1 3 4 17", "", "2 0.5 0.5 0.5 0.5 1 2 3 1 a.png", "", "# end"]
    (tmp_path / "images.txt").write_text("# comment\n" + "\n".join(rows))
    (tmp_path / "cameras.txt").write_text("1 SIMPLE_PINHOLE 64 48 70 32 24\n")
    read = colmap.read(tmp_path)
    assert read.names == ("a.png", "b.png")
    np.testing.assert_allclose(read.camera_to_world[1], [[1, 0, 0, -5], [0, 1, 0, -6], [0, 0, 1, -7], [0, 0, 0, 1]])
    assert (read.intrinsics.fx, read.intrinsics.fy) == (70.0, 70.0)


def test_a_count_in_the_header_that_is_not_that_of_the_images_is_told(tmp_path, caplog):
    colmap.write(tmp_path / "model", winding(4, names=NAMES, intrinsics=PINHOLE), text=True)
    colmap.read(tmp_path / "model")
    assert not caplog.messages
    lines = (tmp_path / "model" / "images.txt").read_text().splitlines()
    (tmp_path / "model" / "images.txt").write_text("\n".join(lines[:-2]))
    assert len(colmap.read(tmp_path / "model")) == 3
    assert "holds 3 images, but its header says 4: is it cut short?" in caplog.text


def test_w_last_is_suspected_where_the_first_camera_is_the_world(tmp_path, caplog):
    images = "1 {} 0 0 0 1 a.png\n\n2 0.8 0.6 0 0 5 6 7 1 b.png\n\n"
    colmap.read(write_text(tmp_path, images.format("1 0 0 0"), CAMERA))
    assert not caplog.messages
    colmap.read(write_text(tmp_path, images.format("0 0 0 1"), CAMERA))
    assert "images.txt, line 1: the camera is at the origin" in caplog.text and "QW QX QY QZ" in caplog.text


def write_text(folder, images, cameras):
    (folder / "images.txt").write_text(images)
    (folder / "cameras.txt").write_text(cameras)
    return folder


@pytest.mark.parametrize(
    ("cameras", "remark"),
    [
        ("1 OPENCV 64 48 70 71 32 24 0 0 0 0\n", "the camera is OPENCV"),
        (CAMERA + "2 PINHOLE 64 48 70 72 32 24\n", "2 different cameras"),
        (CAMERA, "lacks a camera"),
        (CAMERA + CAMERA.replace("1", "2", 1), None),  # equal cameras are one
    ],
)
def test_common_pinholes(tmp_path, cameras, remark):
    read = colmap.read(write_text(tmp_path, ONE + "2 1 0 0 0 5 6 7 2 b.png\n\n", cameras))
    if remark is None:
        assert read.intrinsics.fy == 71.0
    else:
        assert read.intrinsics is None and remark in read.remarks[0]


PARAMS = {
    "SIMPLE_PINHOLE": "70 33 23",
    "SIMPLE_RADIAL": "70 33 23 0.1",
    "RADIAL": "70 33 23 0.1 -0.05",
    "OPENCV": "70 71 33 23 0.1 -0.05 0.01 0.02",
    "FULL_OPENCV": "70 71 33 23 0.1 -0.05 0.01 0.02 0.03 0 0 0",
    "SIMPLE_RADIAL_FISHEYE": "70 33 23 0.1",
    "RADIAL_FISHEYE": "70 33 23 0.1 -0.05",
    "OPENCV_FISHEYE": "70 71 33 23 0.1 -0.05 0.02 0.01",
    "FOV": "70 71 33 23 0.5",
    "FULL_OPENCV ": "70 71 33 23 0.1 -0.05 0.01 0.02 0.03 0.1 0 0",
}


@pytest.mark.parametrize("model", PARAMS)
@pytest.mark.parametrize("other", ["1", "2"])
def test_nerfstudio_has_the_cameras_of_colmap(tmp_path, model, other):
    """Several, or one that is distorted: its lenses project as pycolmap's do, if it has such a model at all."""
    import pycolmap

    write_text(
        tmp_path,
        f"{ONE}2 1 0 0 0 5 6 7 {other} b.png\n\n",
        f"1 {model} 64 48 {PARAMS[model]}\n2 PINHOLE 64 48 80 81 32 24\n",
    )
    trajectory = colmap.read(tmp_path)
    nerfstudio.write(tmp_path / "t.json", trajectory)
    content, again = json.loads((tmp_path / "t.json").read_text()), nerfstudio.read(tmp_path / "t.json")
    assert again.cameras == trajectory.cameras
    if model in ("FOV", "FULL_OPENCV "):
        assert again.cameras is again.intrinsics is None
        return
    points = np.array([[0.1, -0.2, 1.0], [0.3, 0.2, 1.0], [-0.4, 0.1, 2.0]])
    names = [model, "PINHOLE" if other == "2" else model]
    params = [PARAMS[model], "80 81 32 24" if other == "2" else PARAMS[model]]
    for frame, name, numbers in zip(content["frames"], names, params, strict=True):
        camera = pycolmap.Camera(model=name, width=64, height=48, params=[float(word) for word in numbers.split()])
        lens = camera_of({**content, **frame}, "frame", "half", lambda: (0, 0))
        np.testing.assert_allclose(lens.project(points), camera.img_from_cam(points), atol=1e-9)


@pytest.mark.parametrize(
    ("images", "cameras", "message"),
    [
        ("1 1 0 0 0 5 6 1 b.png\n", CAMERA, "line 1: '1 1 0 0 0 5 6 1 b.png'. Expected IMAGE_ID QW"),
        *(
            (ONE, cameras, r"cameras\.txt, (line|camera) 1")
            for cameras in ("1 PINHOLE 64 48 70\n", "1 PINHOLE 64\n", "x\n", "1 PINHOLE 64 48 0 71 32 24\n")
        ),
        (ONE + ONE.replace("1", "2", 1), CAMERA, r"'a.png' is repeated"),
        (ONE.rstrip() + "\n2 1 0 0 0 5 6 7 1 b.png\n", CAMERA, r"line 2: '2 1 0 .*second lists its points"),
        (ONE + "2 1 0 0 0 5 6 7 1 b.png\n3 1 0 0 0 5 6 7 1 c d e.png\n", CAMERA, "line 4: '3 1 0 .*must exist"),
        ("1 1 0 0 0 5 6 7 1 a.png\n\n10.5 1 0 0 0 5 6 7 1\n", CAMERA, "line 3: '10.5 .*Expected IMAGE_ID"),
    ],
)
def test_models_that_are_none(tmp_path, images, cameras, message):
    """Besides those of :data:`tests.datamanagers.kinds.SAID`."""
    refuses("holds no COLMAP model", colmap.read, tmp_path)
    refuses(message, colmap.read, write_text(tmp_path, images, cameras))


def test_names_with_blanks_are_for_binary_models(tmp_path):
    trajectory = winding(1, names=("with blank.png",), intrinsics=PINHOLE)
    refuses(r"'with blank.png'. Expected no blanks", colmap.write, tmp_path / "text", trajectory, text=True)
    colmap.write(tmp_path / "binary", trajectory)
    assert colmap.read(tmp_path / "binary").names == trajectory.names == tuple(by_pycolmap(tmp_path / "binary"))


@given(data=st.data())
@settings(max_examples=30, deadline=None)
def test_binary_files_cut_anywhere_are_refused(tmp_path_factory, data):
    path = tmp_path_factory.mktemp("model")
    colmap.write(path, winding(4, names=NAMES, intrinsics=PINHOLE))
    name = data.draw(st.sampled_from(["images.bin", "cameras.bin"]))
    content = (path / name).read_bytes()
    (path / name).write_bytes(content[: data.draw(st.integers(0, len(content) - 1))])
    refuses("damaged or cut short", colmap.read, path)


def test_a_real_model_read_as_pycolmap_reads_it(shared_data, tmp_path):
    """And as text, with observations and all."""
    import pycolmap

    source = shared_data / "colmap_23img" / "distorted_sparse"
    poses = by_pycolmap(source)
    pycolmap.Reconstruction(str(source)).write_text(str(tmp_path))
    for read in (colmap.read(source), colmap.read(tmp_path)):
        assert read.names == tuple(sorted(poses)) and len(read) == 23
        np.testing.assert_allclose(read.camera_to_world, [poses[name] for name in read.names], atol=1e-12)
        assert "no common pinhole" in read.remarks[0]
