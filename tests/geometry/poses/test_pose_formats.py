"""Every pose format: what comes back, how files are told apart, and what is never replaced."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from scipy.spatial.transform import Rotation

from coliags_plugin.config.registry import pose_formats
from coliags_plugin.core.errors import InputError
from coliags_plugin.core.intrinsics import Intrinsics
from coliags_plugin.geometry.poses import endogslam
from coliags_plugin.geometry.poses.formats import format_named, format_of, write_trajectory
from coliags_plugin.geometry.poses.trajectory import Trajectory, inverse
from tests.geometry.poses.winding import PINHOLE, as_text, trajectories, winding

WRITABLE = [name for name in pose_formats if format_named(name).write is not None]


def same_poses(read: Trajectory, wrote: Trajectory, name: str) -> None:
    """Equal up to what the format loses: digits, and EndoGSLAM's the world."""
    expected, poses = wrote.camera_to_world, read.camera_to_world
    if name == "endogslam":
        expected, poses = (inverse(side[:1]) @ side for side in (expected, poses))
    scale = max(1.0, float(np.abs(expected).max()))
    tolerance = 1e-5 if name == "endogslam" else 1e-10  # its files are float32
    np.testing.assert_allclose(poses, expected, rtol=0, atol=tolerance * scale)


@pytest.mark.parametrize("name", WRITABLE)
@given(trajectory=trajectories(intrinsics=PINHOLE))
@settings(max_examples=6, deadline=None)
def test_what_is_written_is_read(tmp_path_factory, name, trajectory):
    path = tmp_path_factory.mktemp("poses") / "out"
    write_trajectory(path, trajectory, name)
    read = format_named(name).read(path)
    same_poses(read, trajectory, name)
    assert read.intrinsics == (PINHOLE if "intrinsics" in format_named(name).keeps else None)


@pytest.mark.parametrize("name", WRITABLE)
def test_names_and_times_are_kept_content_tells_the_format_and_nothing_is_replaced_unasked(tmp_path, name):
    names = tuple(f"{10 * index}_color.png" for index in range(12))
    times = 1305031102.175304 + np.arange(12) / 30.0
    trajectory = winding(12, names=names, timestamps=times, intrinsics=PINHOLE)
    contents = []
    for path in (tmp_path / "out", tmp_path / "again.whatever"):
        write_trajectory(path, trajectory, name)
        assert format_of(path).name == name.removesuffix("-text")
        contents.append([part.read_bytes() for part in (sorted(path.rglob("*")) if path.is_dir() else [path])])
    assert contents[0] == contents[1]
    with pytest.raises(InputError, match="already exists"):
        write_trajectory(tmp_path / "out", winding(5, intrinsics=PINHOLE), name)
    read = format_named(name).read(tmp_path / "out")
    assert read.names == (names if "names" in format_named(name).keeps else None)
    if "timestamps" in format_named(name).keeps:
        np.testing.assert_array_equal(read.timestamps, times)
    else:
        assert read.timestamps is None
    write_trajectory(tmp_path / "out", winding(5, intrinsics=PINHOLE), name, overwrite=True)
    assert len(format_named(name).read(tmp_path / "out")) == 5
    assert sorted(path.name for path in tmp_path.iterdir()) == ["again.whatever", "out"]


def test_a_folder_of_other_things_is_never_replaced(tmp_path):
    (tmp_path / "project").mkdir()
    (tmp_path / "project" / "thesis.tex").write_text("everything")
    with pytest.raises(InputError, match=r"thesis\.tex, which is not part of a COLMAP model"):
        write_trajectory(tmp_path / "project", winding(intrinsics=PINHOLE), "colmap", overwrite=True)
    with pytest.raises(InputError, match="project is a folder"):
        write_trajectory(tmp_path / "project", winding(), "tum", overwrite=True)
    (tmp_path / "file").write_text("")
    with pytest.raises(InputError, match="file is a file"):
        write_trajectory(tmp_path / "file", winding(intrinsics=PINHOLE), "colmap", overwrite=True)
    assert (tmp_path / "project" / "thesis.tex").read_text() == "everything"


def test_what_is_no_pose_file_is_told(tmp_path):
    for name, text in (("kitti.txt", as_text(np.ones((2, 12)))), ("letter.txt", "Dear"), ("empty", "")):
        (tmp_path / name).write_text(text)
    for name, chosen, message in (
        ("none", None, "no file or folder"),
        ("kitti.txt", None, "its first line holds 12 numbers"),
        ("letter.txt", None, "its first line holds no row of"),
        ("empty", None, "its first line holds no row of"),
        ("", None, r"holds empty, kitti\.txt, letter\.txt\. Expected the folder of a COLMAP"),
        ("empty", "colmab", r"no pose format 'colmab'.*Did you mean 'colmap'"),
        ("", "tum", "is a folder"),
    ):
        with pytest.raises(InputError, match=message):
            format_of(tmp_path / name, chosen)


def test_what_a_format_cannot_hold_is_not_written(tmp_path):
    twice = winding(3, names=("a.png", "b.png", "a.png"), intrinsics=PINHOLE)
    for names, trajectory, message in (
        (("endogslam-truth",), winding(), "format 'endogslam-truth' is read-only"),
        (("colmap", "colmap-text", "endogslam"), winding(), r"no intrinsics.*`intrinsics=fx,fy,cx,cy` and `size="),
        (("colmap", "colmap-text", "nerfstudio"), twice, r"'a\.png' is repeated \(poses 0 and 2\)"),
    ):
        for name in names:
            with pytest.raises(InputError, match=message):
                write_trajectory(tmp_path / "out", trajectory, name)
    assert not list(tmp_path.iterdir())


def test_byte_order_mark_line_ends_and_blank_lines_do_no_harm(tmp_path):
    trajectory = winding(intrinsics=PINHOLE)
    for name in ("c3vd", "tum", "nerfstudio"):
        write_trajectory(tmp_path / name, trajectory, name)
        text = (tmp_path / name).read_text().replace("\n", "\r\n\r\n")
        (tmp_path / name).write_bytes(b"\xef\xbb\xbf" + text.encode())
        assert format_of(tmp_path / name).name == name
        same_poses(format_named(name).read(tmp_path / name), trajectory, name)
    write_trajectory(tmp_path / "colmap", trajectory, "colmap-text")
    for part in ("images.txt", "cameras.txt"):
        text = (tmp_path / "colmap" / part).read_text().replace("\n", "\r\n")
        (tmp_path / "colmap" / part).write_bytes(b"\xef\xbb\xbf" + text.encode())
    same_poses(format_named("colmap").read(tmp_path / "colmap"), trajectory, "colmap")


def test_trajectories_are_checked_and_summed_up():
    poses = winding(3).camera_to_world
    turned, endless = poses.copy(), poses.copy()
    turned[1, :3] *= -1.0
    endless[2, 0, 3] = np.nan
    for matrices, options, message in (
        (poses[:0], {}, r"poses of the shape \[0, 4, 4\]"),
        (poses[:, :3], {}, r"\[3, 3, 4\]"),
        (turned, {}, "pose 1: a left-handed transform"),
        (endless, {}, "pose 2: a transform that is not finite"),
        (poses, {"names": ("a", "b")}, "2 names for 3 poses"),
        (poses, {"timestamps": np.array([0.0, 1.0, np.inf])}, "timestamps"),
    ):
        with pytest.raises(InputError, match=message):
            Trajectory(matrices, **options)
    with pytest.raises(InputError, match="focal lengths and size positive"):
        Intrinsics(0.0, 1.0, 1.0, 1.0, 4, 4)
    poses = np.tile(np.eye(4), (5, 1, 1))
    poses[:, 2, 3] = [0.0, 1.0, 3.0, 4.0, 6.0]
    text = Trajectory(poses).summary("mm")
    assert text == "5 poses, path 6 mm, mean step 1.5 mm, mean looking direction (0.00, 0.00, 1.00)"


def test_every_format_is_in_the_documentation():
    page = Path(__file__).parents[3].joinpath("docs/poses.md").read_text()
    rows = [[cell.strip() for cell in line.strip("|").split("|")] for line in page.splitlines() if "| `" in f" {line}"]
    documented = {row[0].strip("`"): row for row in rows if row[0].strip("`") in pose_formats and len(row) > 5}
    assert sorted(documented) == list(pose_formats)
    for name, row in documented.items():
        assert ("mm" == row[4]) == (format_named(name).unit == "mm")
        assert {word for word in row[5].split(", ") if word} == format_named(name).keeps
        assert ("only read" in row[2]) == (format_named(name).write is None)


FRAMES, GAUSSIANS = 5, 7


def params():
    """Arrays as EndoGSLAM writes them."""
    rng = np.random.default_rng(3)
    return {
        "means3D": rng.normal(size=(GAUSSIANS, 3)),
        "rgb_colors": rng.uniform(size=(GAUSSIANS, 3)),
        "unnorm_rotations": rng.normal(size=(GAUSSIANS, 4)),
        "logit_opacities": rng.normal(size=(GAUSSIANS, 1)),
        "log_scales": rng.normal(size=(GAUSSIANS, 1)),
        "cam_unnorm_rots": rng.normal(size=(1, 4, FRAMES)),
        "cam_trans": rng.normal(size=(1, 3, FRAMES)),
        "timestep": np.zeros(GAUSSIANS),
        "intrinsics": np.array([[400.0, 0, 334.1], [0, 401.0, 273.9], [0, 0, 1]]),
        "w2c": np.eye(4),
        "org_width": np.array(675),
        "org_height": np.array(540),
        "gt_w2c_all_frames": winding(FRAMES).camera_to_world,
        "keyframe_time_indices": np.array([0, 3]),
    }


def saved(path, **changes):
    """Those arrays in a file, with other values or without some keys (None)."""
    np.savez(path, **{key: array for key, array in (params() | changes).items() if array is not None})
    return path


def test_all_of_it_is_read_poses_inverted_and_quaternions_normalised(tmp_path):
    arrays = params()
    read = endogslam.read_params(saved(tmp_path / "params.npz"))
    for frame in range(FRAMES):
        w, x, y, z = arrays["cam_unnorm_rots"][0, :, frame]
        world_to_camera = Rotation.from_quat([x, y, z, w])
        point = np.array([0.3, -0.2, 0.9])
        there = world_to_camera.apply(point) + arrays["cam_trans"][0, :, frame]
        back = read.camera_to_world[frame] @ [*there, 1.0]
        np.testing.assert_allclose(back, [*point, 1.0], atol=1e-12)
    truth = arrays["gt_w2c_all_frames"] @ read.true_camera_to_world
    np.testing.assert_allclose(truth, np.tile(np.eye(4), (FRAMES, 1, 1)), atol=1e-12)
    np.testing.assert_array_equal(read.means, arrays["means3D"])
    np.testing.assert_array_equal(read.rgb_colors, arrays["rgb_colors"])
    # Pixel centres at integers become integers + 0.5.
    assert read.intrinsics == Intrinsics(400.0, 401.0, 334.1 + 0.5, 273.9 + 0.5, 675, 540)
    estimate, truth = (reader(tmp_path / "params.npz") for reader in (endogslam.read, endogslam.read_truth))
    np.testing.assert_array_equal(estimate.camera_to_world, read.camera_to_world)
    np.testing.assert_array_equal(truth.camera_to_world, read.true_camera_to_world)
    assert estimate.intrinsics == read.intrinsics


def test_poses_alone_can_be_read_and_an_unfinished_run_is_remarked_upon(tmp_path):
    only = {key: None for key in params() if key not in ("cam_unnorm_rots", "cam_trans")}
    read = endogslam.read(saved(tmp_path / "params.npz", **only))
    assert len(read) == FRAMES and read.intrinsics is None
    assert read.remarks == ("no intrinsics: the file has no intrinsics, org_width, org_height",)
    quats, translations = params()["cam_unnorm_rots"], params()["cam_trans"]
    quats[0, :, -2:] = np.array([[1.0, 0, 0, 0]]).T
    translations[0, :, -2:] = 0.0
    read = endogslam.read(saved(tmp_path / "params.npz", cam_unnorm_rots=quats, cam_trans=translations))
    assert read.remarks == ("the last 2 poses are the identity: was the run stopped early?",)


def test_one_message_names_every_fault(tmp_path):
    path = saved(
        tmp_path / "params.npz",
        cam_trans=np.zeros((1, 3, 4)),
        means3D=None,
        rgb_colors=np.zeros((GAUSSIANS, 4)),
        intrinsics=np.full((3, 3), np.nan),
        org_width=np.array("wide"),
    )
    with pytest.raises(InputError) as caught:
        endogslam.read_params(path)
    with pytest.raises(InputError, match=r"cannot read .*gone\.npz"):
        endogslam.read_params(tmp_path / "gone.npz")
    for fault in (
        str(path),
        "cam_trans has the shape [1, 3, 4], not [1, 3, 5]",
        "no means3D",
        "rgb_colors has the shape [7, 4], not [N, 3]",
        "intrinsics holds numbers that are not finite",
        "org_width holds <U4, not numbers",
    ):
        assert fault in str(caught.value)
    nothing = {"cam_unnorm_rots": np.ones((1, 4, 0)), "cam_trans": np.ones((1, 3, 0))}
    with pytest.raises(InputError, match="no frames"):
        endogslam.read_params(saved(tmp_path / "params.npz", **nothing, gt_w2c_all_frames=np.ones((0, 4, 4))))


def test_written_files_hold_the_formats_keys_and_the_first_camera_is_the_world(tmp_path):
    trajectory = winding(6, intrinsics=PINHOLE)
    endogslam.write(tmp_path / "params.npz", trajectory)
    with np.load(tmp_path / "params.npz", allow_pickle=False) as archive:
        assert set(archive.files) == set(params()) and archive["cam_unnorm_rots"].shape == (1, 4, 6)
        np.testing.assert_allclose(archive["cam_trans"][0, :, 0], 0.0)
        np.testing.assert_allclose(archive["cam_unnorm_rots"][0, :, 0], [1, 0, 0, 0])
        assert archive["intrinsics"][0, 2] == PINHOLE.cx - 0.5
    read = endogslam.read_params(tmp_path / "params.npz")
    relative = inverse(trajectory.camera_to_world[:1]) @ trajectory.camera_to_world
    np.testing.assert_allclose(read.camera_to_world, relative, atol=1e-4)
    np.testing.assert_allclose(read.true_camera_to_world, relative, atol=1e-4)
    assert read.means.shape == (0, 3)
