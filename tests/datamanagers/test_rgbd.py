"""The rgbd data manager: the phantom's own layout, TUM's and Gaussian Pancakes' habits, and what is refused."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from coliags_plugin.core.errors import InputError
from coliags_plugin.core.scenes import Scene
from coliags_plugin.datamanagers.recognition import find_format
from coliags_plugin.datamanagers.rgbd.reader import RGBDDataManager, RGBDSettings
from coliags_plugin.geometry.poses import tum
from coliags_plugin.geometry.poses.association import nearest_in_time
from coliags_plugin.geometry.poses.trajectory import Trajectory
from tests.datamanagers.wall_scenes import PINHOLE, colors, look, off_wall, poses, rays

WIDTH, HEIGHT = 64, 48
#: As camera.json has it, pixel centres at integers.
OPENCV = {"fx": PINHOLE.fx, "fy": PINHOLE.fy, "cx": PINHOLE.cx - 0.5, "cy": PINHOLE.cy - 0.5}
#: Steps per mm: 0.001 mm each.
SCALE = 1000.0


def load(folder: Path, **options) -> Scene:
    return RGBDDataManager(RGBDSettings(**{"width": WIDTH, "height": HEIGHT, **options})).load(folder)


def names(frames) -> list[str]:
    return [frame.name for frame in frames]


def everything(scene: Scene) -> list:
    return sorted([*scene.train, *scene.test_sets.get("test", [])], key=lambda frame: frame.index)


def write_wall(
    folder: Path,
    stems: list[str],
    pose_times: list[float] | None = None,
    depth_stems: list[str] | None = None,
    color_suffix: str = ".png",
    places: tuple[str, str] = ("rgb", "depth"),
    trajectory: str = "groundtruth.txt",
) -> Path:
    """The tilted wall: image i is taken from pose i and called ``stems[i]``."""
    count = len(stems)
    directions = rays(PINHOLE)
    for place in places:
        (folder / place).mkdir(parents=True)
    for index, pose in enumerate(poses(count)):
        depth, color = look(pose, directions)
        cv2.imwrite(str(folder / places[0] / f"{stems[index]}{color_suffix}"), color[..., ::-1])
        steps = np.rint(depth * SCALE).astype(np.uint16)
        cv2.imwrite(str(folder / places[1] / f"{(depth_stems or stems)[index]}.png"), steps)
    tum.write(folder / trajectory, Trajectory(poses(count), timestamps=np.array(pose_times or range(count), float)))
    camera = {**OPENCV, "w": WIDTH, "h": HEIGHT, "depth_scale": SCALE}
    (folder / "camera.json").write_text(json.dumps(camera))
    return folder


def stamps(count: int, start: float = 1305031102.0) -> list[str]:
    return [f"{start + index / 30:.6f}" for index in range(count)]


def seconds(stems: list[str]) -> list[float]:
    return [float(stem) for stem in stems]


@pytest.fixture(scope="module")
def timed(tmp_path_factory):
    stems = stamps(9)
    return write_wall(tmp_path_factory.mktemp("timed") / "wall", stems, seconds(stems))


@pytest.fixture(scope="module")
def numbered(tmp_path_factory):
    return write_wall(tmp_path_factory.mktemp("numbered") / "wall", [str(index) for index in range(12)])


@pytest.fixture
def mine(timed, tmp_path):
    """A copy to spoil, with times for names."""
    return Path(shutil.copytree(timed, tmp_path / "wall"))


@pytest.fixture
def my_numbered(numbered, tmp_path):
    return Path(shutil.copytree(numbered, tmp_path / "wall"))


def worst(frame) -> tuple[float, int]:
    """How far the frame's depth is off the wall, mm, and its colours off the pattern there."""
    points = frame.camera.unproject(frame.depth).double().numpy().reshape(-1, 3)
    difference = np.abs(frame.image.numpy().reshape(-1, 3).astype(int) - colors(points))
    return off_wall(points).max(), difference.max()


def test_a_phantom_is_written_as_tum_names_things(phantoms):
    folder = phantoms["rgbd"]
    assert not (folder / "rotation").exists()
    listed = (folder / "rgb.txt").read_text().splitlines()[1:]
    assert listed[0] == "1305031102.000000 rgb/1305031102.000000.png"
    assert all((folder / line.split()[1]).is_file() for line in listed)
    assert json.loads((folder / "phantom.json").read_text())["settings"]["rotation_views"] == 0
    camera, k = json.loads((folder / "camera.json").read_text()), load(folder, width=64, height=51).train[0].camera
    assert (k.fx, k.cy) == pytest.approx((camera["fx"], camera["cy"] + 0.5), rel=1e-12)


class TestTimes:
    def test_the_wall_is_where_it_was(self, timed):
        scene = load(timed)
        assert names(everything(scene)) == stamps(9)
        for frame in scene.train:
            distance, difference = worst(frame)
            assert distance < 0.001
            assert difference <= 1
        np.testing.assert_allclose(scene.train[3].camera.camera_to_world, poses(9)[4], atol=1e-6)
        assert scene.provenance["association"] == {
            "by": "time",
            "without_pose": 0,
            "without_depth": 0,
            "largest_difference_s": 0.0,
        }
        assert scene.provenance["depth_scale"] == SCALE
        json.dumps(scene.provenance, allow_nan=False)

    def test_clocks_that_nearly_agree(self, tmp_path):
        stems = stamps(9)
        folder = write_wall(
            tmp_path / "wall",
            stems,
            [time + 0.009 for time in seconds(stems)],
            [f"{time - 0.008:.6f}" for time in seconds(stems)],
        )
        scene = load(folder)
        assert max(worst(frame)[0] for frame in everything(scene)) < 0.001
        assert scene.provenance["association"]["largest_difference_s"] == pytest.approx(0.009, abs=1e-6)

    def test_a_motion_capture_that_is_faster_than_the_camera(self, mine):
        times = np.array(seconds(stamps(9)))
        fine = np.linspace(times[0] - 0.5, times[-1] + 0.5, 1000)
        known = poses(9)
        matrices = np.tile(np.eye(4), (1009, 1, 1))
        matrices[1000:] = known
        # Out of order, too: files that were merged are.
        tum.write(mine / "groundtruth.txt", Trajectory(matrices, timestamps=np.concatenate([fine, times])))
        assert max(worst(frame)[0] for frame in everything(load(mine))) < 0.001

    def test_images_without_a_pose_or_depth_are_left_out_and_counted(self, mine, caplog):
        lines = (mine / "groundtruth.txt").read_text().splitlines()
        (mine / "groundtruth.txt").write_text("\n".join([*lines[:3], *lines[4:9]]) + "\n")
        (mine / "depth" / f"{stamps(9)[4]}.png").unlink()
        scene = load(mine)
        left = [stem for index, stem in enumerate(stamps(9)) if index not in (2, 4, 8)]
        assert names(everything(scene)) == left
        assert scene.provenance["association"]["without_pose"] == 2
        assert scene.provenance["association"]["without_depth"] == 1
        assert "of 9 images 2 have no pose and 1 no depth" in caplog.text
        assert max(worst(frame)[0] for frame in everything(scene)) < 0.001

    def test_times_are_sorted_as_numbers(self, tmp_path):
        stems = [f"{index * 0.5 + 8.5}" for index in range(9)]
        folder = write_wall(tmp_path / "wall", stems, seconds(stems))
        scene = load(folder)
        assert names(everything(scene)) == stems
        assert max(worst(frame)[0] for frame in everything(scene)) < 0.001

    def test_another_clock(self, mine):
        stems = stamps(9, start=5.0)
        tum.write(mine / "groundtruth.txt", Trajectory(poses(9), timestamps=np.array(seconds(stems))))
        with pytest.raises(InputError, match=r"no pose of .*groundtruth.txt is within 0.02 .*1305031102.000000 .*5.0"):
            load(mine)
        scene = load(mine, association="order")
        assert max(worst(frame)[0] for frame in everything(scene)) < 0.001

    def test_depth_of_another_clock(self, mine):
        for path in (mine / "depth").iterdir():
            path.rename(path.with_name(f"{float(path.stem) + 100:.6f}.png"))
        with pytest.raises(InputError, match=r"no depth file within 0.02 of an image that has a pose"):
            load(mine)

    def test_a_name_that_is_no_time(self, my_numbered):
        (my_numbered / "rgb" / "3.png").rename(my_numbered / "rgb" / "three.png")
        with pytest.raises(InputError, match=r"three.png: its name is not a timestamp"):
            load(my_numbered, association="time")

    def test_the_same_time_twice(self, mine):
        first = mine / "rgb" / f"{stamps(9)[0]}.png"
        shutil.copy(first, first.with_suffix(".jpg"))
        with pytest.raises(InputError, match=r"1305031102.000000.* have the same timestamp"):
            load(mine)


@given(
    st.lists(st.integers(0, 60), min_size=1, max_size=12, unique=True),
    st.lists(st.integers(0, 60), min_size=1, max_size=12, unique=True),
    st.integers(0, 5),
)
@settings(max_examples=60, deadline=None)
def test_nearest_in_time(wanted, known, tolerance):
    wanted, known = np.array(wanted, float), np.array(known, float)
    partner = nearest_in_time(wanted, known, tolerance)
    made = partner >= 0
    assert len(set(partner[made])) == made.sum()
    assert (np.abs(wanted[made] - known[partner[made]]) <= tolerance).all()
    # Whoever went without had nothing nearer than what its candidates got.
    for index in np.flatnonzero(~made):
        for candidate in np.flatnonzero(np.abs(known - wanted[index]) <= tolerance):
            (owner,) = np.flatnonzero(partner == candidate)
            assert abs(wanted[owner] - known[candidate]) <= abs(wanted[index] - known[candidate])


class TestOrder:
    def test_unpadded_names_count_as_people_do(self, numbered):
        scene = load(numbered)
        assert names(everything(scene)) == [str(index) for index in range(12)]
        assert max(worst(frame)[0] for frame in everything(scene)) < 0.001
        assert scene.provenance["association"] == {"by": "order"}

    def test_whole_numbers_can_be_times(self, my_numbered):
        lines = (my_numbered / "groundtruth.txt").read_text().splitlines()
        (my_numbered / "groundtruth.txt").write_text("\n".join(lines[:6] + lines[7:]) + "\n")
        with pytest.raises(InputError, match=r"groundtruth.txt has 11 poses for 12 images.*association=time"):
            load(my_numbered)
        scene = load(my_numbered, association="time")
        assert names(everything(scene)) == [str(index) for index in range(12) if index != 5]
        assert max(worst(frame)[0] for frame in everything(scene)) < 0.001

    def test_a_pose_and_another_image_lost(self, my_numbered):
        """As many poses as images, but not of the same frames: the numbers in the trajectory tell."""
        lines = (my_numbered / "groundtruth.txt").read_text().splitlines()
        (my_numbered / "groundtruth.txt").write_text("\n".join(lines[:6] + lines[7:]) + "\n")
        for part in ("rgb", "depth"):
            (my_numbered / part / "7.png").unlink()
        with pytest.raises(InputError, match=r"pose 5 has timestamp 6, but image 5 is 5.png"):
            load(my_numbered)
        assert len(everything(load(my_numbered, association="order"))) == 11
        scene = load(my_numbered, association="time")
        assert len(everything(scene)) == 10
        assert max(worst(frame)[0] for frame in everything(scene)) < 0.001

    def test_a_name_without_number(self, my_numbered):
        shutil.copy(my_numbered / "rgb" / "4.png", my_numbered / "rgb" / "cover.png")
        with pytest.raises(InputError, match=r"cover.png: no number in its name"):
            load(my_numbered)


class TestDepthScale:
    def test_two_that_differ(self, mine):
        with pytest.raises(InputError, match=r"depth_scale = 1000, but the option depth_scale is 5000"):
            load(mine, depth_scale=5000.0)
        assert load(mine, depth_scale=SCALE).provenance["depth_scale"] == SCALE

    @pytest.mark.parametrize("scale", [1e-7, 1e-320, 1e300])
    def test_that_makes_depth_absurd(self, mine, scale):
        camera = json.loads((mine / "camera.json").read_text())
        (mine / "camera.json").write_text(json.dumps({**camera, "depth_scale": scale}))
        with pytest.raises(InputError, match=r"depth reaches from .* scene units"):
            load(mine).train[0].depth  # noqa: B018

    def test_zero_is_unknown(self, mine):
        path = mine / "depth" / f"{stamps(9)[1]}.png"
        steps = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
        steps[:10] = 0
        cv2.imwrite(str(path), steps)
        frame = load(mine).train[0]
        assert torch.isnan(frame.depth[:10]).all()
        assert torch.isfinite(frame.depth[10:]).all()
        assert frame.depth_at_least is None


class TestPancakes:
    """Gaussian Pancakes' folder: relative depth, poses by order, COLMAP's camera, a mesh for the first points."""

    @pytest.fixture
    def folder(self, tmp_path):
        stems = [f"{index}_color" for index in range(12)]
        depth_stems = [f"{index}_depth" for index in range(12)]
        folder = write_wall(
            tmp_path / "pancakes",
            stems,
            depth_stems=depth_stems,
            color_suffix=".jpg",
            places=("images", "depths"),
            trajectory="rnnslam_poses.txt",
        )
        (folder / "camera.json").unlink()
        (folder / "cameras.txt").write_text(
            f"# Camera list\n1 PINHOLE {WIDTH} {HEIGHT} {PINHOLE.fx} {PINHOLE.fy} {PINHOLE.cx} {PINHOLE.cy}\n"
        )
        (folder / "mesh.obj").write_text("# v\nv 1 2 40 1.0 0.5 0\nv -1.5 0 41 0 0 1\nvt 0 0\nf 1/1 2/1 1/1\n")
        return folder

    def test_without_its_depth(self, folder):
        assert find_format(folder) == "rgbd"
        scene = load(folder, depth="none")
        frames = everything(scene)
        assert names(frames) == [f"{index}_color" for index in range(12)]
        assert all(frame.depth is None for frame in frames)
        np.testing.assert_allclose(frames[10].camera.camera_to_world, poses(12)[10], atol=1e-6)
        camera = frames[0].camera
        assert (camera.fx, camera.fy, camera.cx, camera.cy) == (PINHOLE.fx, PINHOLE.fy, 33.5, 21.5)
        assert scene.points.positions.tolist() == [[1.0, 2.0, 40.0], [-1.5, 0.0, 41.0]]
        assert scene.points.colors.tolist() == [[255, 128, 0], [0, 0, 255]]
        assert scene.provenance["points"]["source"] == "mesh.obj"

    def test_metric_depth_where_it_is_metric(self, folder):
        with pytest.raises(InputError, match=r"or --set datamanager.depth=none if it is relative"):
            load(folder)
        assert worst(load(folder, depth_scale=SCALE).train[0])[0] < 0.001

    def test_its_own_points_go_before_the_mesh(self, folder):
        ply = "ply\nformat ascii 1.0\nelement vertex 1\n" + "".join(f"property float {axis}\n" for axis in "xyz")
        (folder / "points3D.ply").write_text(f"{ply}end_header\n3 4 5\n")
        assert load(folder, depth="none").points.positions.tolist() == [[3.0, 4.0, 5.0]]

    @pytest.mark.parametrize("line", ["v 1 2", "v 1 2 three", "v 1 2 3"])
    def test_a_mesh_with_a_bad_vertex(self, folder, line):
        with (folder / "mesh.obj").open("a") as file:
            file.write(f"{line}\n")
        with pytest.raises(InputError, match=rf"mesh.obj, line 6: '{line}'"):
            load(folder, depth="none")

    def test_simple_pinhole(self, folder):
        (folder / "cameras.txt").write_text(f"1 SIMPLE_PINHOLE {WIDTH} {HEIGHT} 60 32 24\n")
        camera = load(folder, depth="none").train[0].camera
        assert (camera.fx, camera.fy, camera.cx, camera.cy) == (60.0, 60.0, 32.0, 24.0)

    @pytest.mark.parametrize(
        ("text", "message"),
        [
            ("1 OPENCV 64 48 60 60 32 24 0.1 0 0 0", r"the camera is OPENCV.*Undistort"),
            ("1 PINHOLE 64 48 60 60 32", r"'1 PINHOLE 64 48 60 60 32'"),
            ("1 PINHOLE 64 48 sixty 60 32 24", r"'1 PINHOLE 64 48 sixty"),
            ("1 PINHOLE 64 48 60 60 32 24\n2 PINHOLE 64 48 60 60 32 24", r"has 2 cameras"),
            ("# nothing", r"has 0 cameras"),
        ],
    )
    def test_cameras_that_do_not_do(self, folder, text, message):
        (folder / "cameras.txt").write_text(text + "\n")
        with pytest.raises(InputError, match=message):
            load(folder, depth="none")


class TestIntrinsics:
    @pytest.mark.parametrize("text", ["61 55 33 21\n", "61, 55, 33, 21", "61 0 33\n0 55 21\n0 0 1\n"])
    def test_text(self, mine, text):
        (mine / "camera.json").unlink()
        (mine / "intrinsics.txt").write_text(text)
        scene = load(mine, depth_scale=SCALE)
        assert worst(scene.train[0])[0] < 0.001
        assert scene.provenance["intrinsics_from"] == "intrinsics.txt"

    @pytest.mark.parametrize(
        ("text", "message"),
        [
            ("61 55 33", r"intrinsics.txt: '61 55 33'"),
            ("61 55 33 x", r"intrinsics.txt: '61 55 33 x'"),
            ("61 2 33 0 55 21 0 0 1", r"without skew"),
            ("0 55 33 21", r"intrinsics.txt: '0 55 33 21'"),
            ("122 110 66 42", r"principal point \(66, 42\) is far from the middle of .*png, 64 x 48"),
            ("30 27 16 10", r"principal point \(16, 10\) is far from the middle"),
        ],
    )
    def test_text_that_does_not_do(self, mine, text, message):
        (mine / "camera.json").unlink()
        (mine / "intrinsics.txt").write_text(text)
        with pytest.raises(InputError, match=message):
            load(mine, depth_scale=SCALE)


class TestRefused:
    def test_a_named_trajectory(self, mine):
        (mine / "slam").mkdir()
        (mine / "groundtruth.txt").rename(mine / "slam" / "estimate.txt")
        assert len(load(mine, trajectory="slam/estimate.txt").train) == 7
        with pytest.raises(InputError, match=r"no file .*slam/other.txt"):
            load(mine, trajectory="slam/other.txt")

    def test_other_files_do_not_make_it_a_scene(self, mine):
        assert RGBDDataManager.recognise(mine) == "the TUM trajectory groundtruth.txt beside rgb/"
        (mine / "groundtruth.txt").write_text("1,0,0,0,0,1,0,0,0,0,1,0,0,0,0,1\n")
        assert RGBDDataManager.recognise(mine) is None
        assert RGBDDataManager.recognise(mine / "rgb") is None
        assert RGBDDataManager.recognise(mine / "camera.json") is None
