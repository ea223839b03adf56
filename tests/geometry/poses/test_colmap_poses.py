"""COLMAP models against pycolmap, which reads and writes them independently."""

from __future__ import annotations

import json

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from coliags_plugin.core.errors import InputError
from coliags_plugin.datamanagers.reading.transforms import camera_of
from coliags_plugin.geometry.poses import colmap, nerfstudio
from tests.geometry.poses.winding import PINHOLE, winding

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
        assert read.intrinsics is None
        assert remark in read.remarks[0]


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
    with pytest.raises(InputError, match="holds no COLMAP model"):
        colmap.read(tmp_path)
    with pytest.raises(InputError, match=message):
        colmap.read(write_text(tmp_path, images, cameras))


def test_names_with_blanks_are_for_binary_models(tmp_path):
    trajectory = winding(1, names=("with blank.png",), intrinsics=PINHOLE)
    with pytest.raises(InputError, match=r"'with blank.png'. Expected no blanks"):
        colmap.write(tmp_path / "text", trajectory, text=True)
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
    with pytest.raises(InputError, match="damaged or cut short"):
        colmap.read(path)


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
