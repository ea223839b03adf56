"""Every pose format: what comes back, and what is never replaced; alignment of trajectories and their errors."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from coliags_plugin.core.errors import InputError
from coliags_plugin.core.intrinsics import Intrinsics
from coliags_plugin.core.registry import pose_formats
from coliags_plugin.geometry.poses import endogslam
from coliags_plugin.geometry.poses.alignment import align, associate, umeyama
from coliags_plugin.geometry.poses.formats import format_named, format_of, write_trajectory
from coliags_plugin.geometry.poses.trajectory import Trajectory, inverse
from tests.commands import refuses
from tests.geometry.poses.winding import PINHOLE, as_text, some_transform, trajectories, winding

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
    refuses("already exists", write_trajectory, tmp_path / "out", winding(5, intrinsics=PINHOLE), name)
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
    refuses("project is a folder", write_trajectory, tmp_path / "project", winding(), "tum", overwrite=True)
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
        refuses(message, format_of, tmp_path / name, chosen)


def test_what_a_format_cannot_hold_is_not_written(tmp_path):
    twice = winding(3, names=("a.png", "b.png", "a.png"), intrinsics=PINHOLE)
    for names, trajectory, message in (
        (("endogslam-truth",), winding(), "format 'endogslam-truth' is read-only"),
        (("colmap", "colmap-text", "endogslam"), winding(), r"no intrinsics.*`intrinsics=fx,fy,cx,cy` and `size="),
        (("colmap", "colmap-text", "nerfstudio"), twice, r"'a\.png' is repeated \(poses 0 and 2\)"),
    ):
        for name in names:
            refuses(message, write_trajectory, tmp_path / "out", trajectory, name)
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
        refuses(message, Trajectory, matrices, **options)
    refuses("focal lengths and size positive", Intrinsics, 0.0, 1.0, 1.0, 1.0, 4, 4)
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
    refuses(r"cannot read .*gone\.npz", endogslam.read_params, tmp_path / "gone.npz")
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


SEEDS = st.integers(0, 10_000)
SCALES = st.floats(0.01, 100.0)


def moved(trajectory, transform, scale=1.0):
    """A copy of a trajectory in another world."""
    poses = transform @ trajectory.camera_to_world
    poses[:, :3, 3] = scale * (transform[:3, :3] @ trajectory.centers.T).T + transform[:3, 3]
    return Trajectory(poses)


def aligned(estimate, reference, **options):
    return align(estimate, reference, associate(estimate, reference), **options)


@given(trajectory=trajectories(), seed=SEEDS, scale=SCALES, with_scale=st.booleans())
@settings(max_examples=40, deadline=None)
def test_a_known_motion_is_recovered(trajectory, seed, scale, with_scale):
    transform, scale = some_transform(seed), scale if with_scale else 1.0
    target = scale * trajectory.centers @ transform[:3, :3].T + transform[:3, 3]
    fit = umeyama(trajectory.centers, target, with_scale)
    size = max(1.0, float(np.abs(target).max()))
    np.testing.assert_allclose(fit.points(trajectory.centers), target, rtol=0, atol=1e-9 * size)
    assert fit.scale == pytest.approx(scale, rel=1e-7)
    np.testing.assert_allclose(fit.rotation, transform[:3, :3], atol=1e-6)


@given(seed=SEEDS, count=st.integers(4, 20))
@settings(max_examples=20, deadline=None)
def test_rotation_is_scipys(seed, count):
    rng = np.random.default_rng(seed)
    source, target = rng.normal(size=(2, count, 3))
    fit = umeyama(source, target)
    expected, _ = Rotation.align_vectors(target - target.mean(axis=0), source - source.mean(axis=0))
    np.testing.assert_allclose(fit.rotation, expected.as_matrix(), atol=1e-6)
    assert np.linalg.det(fit.rotation) == pytest.approx(1.0)


@pytest.mark.parametrize("scale", [1.0, 2.5])
def test_a_straight_path_has_errors_too(scale):
    """Any rotation about the line fits its positions."""
    poses = winding(10, 4).camera_to_world.copy()
    poses[:, :3, 3] = np.linspace(0.0, 30.0, 10)[:, None] * (0.4, 0.9, -0.2)
    reference = Trajectory(poses)
    result = aligned(moved(reference, some_transform(3), scale), reference, with_scale=scale != 1.0)
    assert result.ate.max < 1e-10 and result.rpe_translation.max < 1e-10 and result.rpe_rotation_deg.max < 1e-5
    assert result.transform.scale == pytest.approx(1.0 / scale)
    assert np.linalg.det(result.transform.rotation) == pytest.approx(1.0)


@pytest.mark.parametrize("away", [0.0, 100.0])
def test_a_camera_that_stays_in_place_has_no_scale(away):
    poses = winding(6, 2).camera_to_world.copy()
    poses[:, :3, 3] = away
    still = Trajectory(poses)
    extent = winding(6).centers - winding(6).centers.mean(axis=0)
    assert aligned(still, winding(6)).ate.rmse == pytest.approx(np.sqrt((extent**2).sum(axis=1).mean()))
    for pair in ((still, winding(6)), (winding(6), still), (still, still)):
        refuses("a scale cannot be estimated", aligned, *pair, with_scale=True)


@pytest.mark.parametrize("delta", [1, 3])
def test_errors_by_their_definitions(delta):
    """Sturm et al., equations 1 to 5, frame by frame, of poses with noise."""
    reference, rng = winding(12, 1), np.random.default_rng(2)
    poses = reference.camera_to_world.copy()
    poses[:, :3, 3] += rng.normal(0.0, 0.5, (12, 3))
    poses[:, :3, :3] = Rotation.from_rotvec(rng.normal(0.0, 0.05, (12, 3))).as_matrix() @ poses[:, :3, :3]
    estimate = Trajectory(poses)
    result = aligned(estimate, reference, delta=delta)
    transform = np.eye(4)
    transform[:3, :3], transform[:3, 3] = result.transform.rotation, result.transform.translation
    translations, angles, positions = [], [], []
    for index in range(12):
        true, estimated = reference.camera_to_world[index], estimate.camera_to_world[index]
        absolute = np.linalg.inv(true) @ transform @ estimated
        positions.append(np.linalg.norm(absolute[:3, 3]))
        if index + delta < 12:
            after, found_after = reference.camera_to_world[index + delta], estimate.camera_to_world[index + delta]
            error = np.linalg.inv(np.linalg.inv(true) @ after) @ (np.linalg.inv(estimated) @ found_after)
            translations.append(np.linalg.norm(error[:3, 3]))
            angles.append(np.rad2deg(np.arccos((np.trace(error[:3, :3]) - 1) / 2)))
    np.testing.assert_allclose(result.position_errors, positions)
    report = json.loads(json.dumps(result.to_json("mm"), allow_nan=False))
    assert report["alignment"] == "SE(3)" and report["frames"]["position_error"] == result.position_errors.tolist()
    assert report["ate_share_of_path"] == pytest.approx(result.ate.rmse / reference.steps.sum())
    for errors, spread in (
        (positions, result.ate),
        (translations, result.rpe_translation),
        (angles, result.rpe_rotation_deg),
    ):
        rmse = np.sqrt(np.mean(np.square(errors)))
        expected = [rmse, np.mean(errors), np.median(errors), np.max(errors)]
        assert list(vars(spread).values()) == pytest.approx(expected, rel=1e-6)
    for step in (0, -1, 12, 100):
        refuses(f"over {step} frames, and 12 matched frames.*1 to 11", aligned, estimate, reference, delta=step)


def named(names, **options):
    return winding(len(names), names=tuple(names), **options)


def pairs(matches):
    return list(zip(matches.first.tolist(), matches.second.tolist(), strict=True))


TWINS = ["left/a.png", "right/a.png", "left/b.png"]
TIMED = (
    winding(4, timestamps=np.array([0.0, 0.1, 0.2, 0.3])),
    winding(5, timestamps=np.array([0.305, 0.099, 0.11, 0.211, 9.0])),
)


@pytest.mark.parametrize(
    ("first", "second", "by", "expected", "skipped"),
    [
        (named(["c", "a", "x", "b"]), named(["a", "b", "c", "d", "e"]), "name", [(0, 2), (1, 0), (3, 1)], None),
        # Names' last parts, where folders and suffixes differ; one that several frames share serves nobody.
        (named(["i/a.png", "i/b.png", "i/c"]), named(["c.jpg", "b.jpg", "a"]), "name", [(0, 2), (1, 1), (2, 0)], None),
        (named(TWINS), named(["a.jpg", "b.jpg", "c.jpg"]), "index", None, ("by name: 'a' names several frames",)),
        (named(TWINS), named(TWINS), "name", None, None),
        (*TIMED, "time", [(1, 1), (2, 3), (3, 0)], None),
        (winding(5), winding(5, timestamps=np.arange(5.0)), "index", [(k, k) for k in range(5)], ()),
        (*[winding(5, timestamps=np.zeros(5))] * 2, "index", None, ("by time: timestamps are repeated",)),
    ],
)  # fmt: skip
def test_by_name_then_time_then_index(first, second, by, expected, skipped):
    matches = associate(first, second)
    assert matches.by == by
    assert expected is None or pairs(matches) == expected
    assert skipped is None or matches.skipped == skipped


@given(seed=SEEDS)
@settings(max_examples=20, deadline=None)
def test_by_time_is_greedy_over_all_pairs(seed):
    rng = np.random.default_rng(seed)
    times = [np.unique(rng.uniform(0, 1, 12)), rng.permutation(np.unique(rng.uniform(0, 1, 15)))]
    first, second = (winding(len(side), timestamps=side) for side in times)
    gaps = np.abs(times[0][:, None] - times[1])
    expected = []
    while gaps.min() <= 0.05:
        i, j = np.unravel_index(np.argmin(gaps), gaps.shape)
        expected.append((int(i), int(j)))
        gaps[i], gaps[:, j] = np.inf, np.inf
    if len(expected) < 3:
        return
    assert pairs(associate(first, second, "time", 0.05)) == sorted(expected)


@pytest.mark.parametrize(
    ("first", "second", "how", "message"),
    [
        (winding(18), winding(20), (), r"18 and 20 poses.*pass `match=endogslam-train`"),
        (winding(17), winding(20), ("endogslam-train",), "17 poses are not the training frames of 20"),
        (named("abc"), named("wxyz"), (), r"by name: no name in common; by index: 3 and 4 poses"),
        (named("abc"), winding(3), ("name",), "by name: not both have names"),
        (winding(2), winding(2), (), "by index: 2 frames match"),
        (*TIMED, ("time", 0.006), r"by time: 2 within 0.006 s"),
    ],
)
def test_what_cannot_be_matched_says_what_was_tried(first, second, how, message):
    refuses(message, associate, first, second, *how)
