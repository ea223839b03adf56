"""The c3vd data manager, from files to scene."""

from __future__ import annotations

import json
import os
import shutil
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from pydantic import ValidationError

from coliags_plugin.core.errors import InputError
from coliags_plugin.core.scenes import Frame, PointCloud, Scene
from coliags_plugin.datamanagers.c3vd.reader import C3VDDataManager, C3VDSettings
from coliags_plugin.datamanagers.reading.camera_json import read_intrinsics
from coliags_plugin.geometry.lenses.models import LENSES
from tests.datamanagers.wall_scenes import PINHOLE, colors, off_wall, poses, write_raw, write_undistorted

LENS_NAMES = sorted(LENSES)


def load(folder: Path, **options) -> Scene:
    return C3VDDataManager(C3VDSettings(**options)).load(folder)


def small(folder: Path, **options) -> Scene:
    return load(folder, **{"width": 64, "height": 48, **options})


@pytest.fixture(scope="module")
def undistorted(tmp_path_factory):
    return write_undistorted(tmp_path_factory.mktemp("undistorted") / "wall")


@pytest.fixture(scope="module")
def raw(tmp_path_factory):
    return write_raw(tmp_path_factory.mktemp("raw") / "wall")


@pytest.fixture
def mine(undistorted, tmp_path):
    """A copy to spoil."""
    return Path(shutil.copytree(undistorted, tmp_path / "wall"))


@pytest.fixture
def my_raw(raw, tmp_path):
    return Path(shutil.copytree(raw, tmp_path / "raw_wall"))


def names(frames):
    return [frame.name for frame in frames]


def worst_off_wall(frame: Frame) -> float:
    points = frame.camera.unproject(frame.depth).reshape(-1, 3).double().numpy()
    return off_wall(points[np.isfinite(points).all(1)]).max()


def color_errors(frame: Frame) -> np.ndarray:
    """How far the image is from the wall's pattern at the points that its depth gives."""
    points = frame.camera.unproject(frame.depth).double().numpy()
    keep = np.isfinite(points).all(-1)
    return np.abs(frame.image.numpy()[keep].astype(int) - colors(points)[keep])


class TestScene:
    def test_frames_are_what_was_written(self, undistorted):
        scene = small(undistorted)
        assert scene.name == "wall"
        assert names(scene.test_sets["test"]) == ["0000_color", "0008_color"]
        assert names(scene.train) == [f"{index:04d}_color" for index in range(1, 8)]
        frame = scene.train[2]
        assert frame.index == 3
        camera = frame.camera
        assert (camera.fx, camera.fy, camera.cx, camera.cy) == (61.0, 55.0, 33.5, 21.5)
        np.testing.assert_allclose(camera.camera_to_world, poses(9)[3], atol=1e-6)
        assert frame.image.dtype == torch.uint8
        assert frame.depth.dtype == torch.float32
        assert frame.mask is None
        assert frame.seen is None
        assert worst_off_wall(frame) < 0.002
        assert color_errors(frame).max() <= 1

    def test_initial_points_lie_on_the_wall_and_carry_its_colours(self, undistorted):
        points = small(undistorted).points
        assert len(points) == 7 * 64 * 48
        assert off_wall(points.positions.double().numpy()).max() < 0.002
        assert np.abs(points.colors.numpy().astype(int) - colors(points.positions.double().numpy())).max() <= 1

    def test_test_frames_leave_no_points(self, undistorted, tmp_path):
        folder = Path(shutil.copytree(undistorted, tmp_path / "wall"))
        for index in range(9):
            if index % 8:
                cv2.imwrite(str(folder / f"depths/{index:04d}_depth.png"), np.zeros((48, 64), np.uint16))
        with pytest.raises(InputError, match="none of the 7 training frames has a valid depth"):
            small(folder)

    def test_points_count_and_seed(self, undistorted):
        first, again = (small(undistorted, points_count=500).points.positions for _ in range(2))
        assert len(first) == 500
        assert torch.equal(first, again)
        assert not torch.equal(first, small(undistorted, points_count=500, seed=1).points.positions)

    @pytest.mark.parametrize("size", [(32, 24), (50, 30), (128, 96)])
    def test_other_sizes_keep_the_geometry(self, undistorted, size):
        scene = load(undistorted, width=size[0], height=size[1])
        frame = scene.train[4]
        assert frame.image.shape == (size[1], size[0], 3)
        assert frame.depth.shape == (size[1], size[0])
        assert frame.camera.cx == pytest.approx(33.5 * size[0] / 64)
        # Nearest depth lies up to half a stored pixel beside its ray: on this slope a few tenths of a millimetre.
        assert worst_off_wall(frame) < 0.3
        assert color_errors(frame).max() < 12

    @pytest.mark.skipif(not Path("/proc/self/fd").is_dir(), reason="counts open files through /proc")
    def test_no_file_stays_open(self, undistorted):
        small(undistorted)
        before = len(os.listdir("/proc/self/fd"))
        small(undistorted)
        assert len(os.listdir("/proc/self/fd")) <= before


class TestRaw:
    @pytest.mark.parametrize("name", LENS_NAMES)
    def test_undistorted_geometry_is_right_through_every_lens(self, tmp_path, name):
        folder = write_raw(tmp_path / "wall", LENSES[name].resized(270, 216), count=2)
        scene = load(folder, width=90, height=72, lens=name)
        frame = scene.train[0]
        k = LENSES[name].resized(90, 72).pinhole
        camera = frame.camera
        assert (camera.fx, camera.fy) == pytest.approx((k.fx, k.fy))
        assert (camera.cx, camera.cy) == pytest.approx((k.cx, k.cy))
        assert worst_off_wall(frame) < 0.2
        assert color_errors(frame).max() < 12
        assert off_wall(scene.points.positions.double().numpy()).max() < 0.2
        assert scene.provenance["lens"] == name

    def test_the_wrong_lens_shows(self, tmp_path):
        folder = write_raw(tmp_path / "wall", LENSES["omnidirectional"].resized(270, 216), count=2)
        assert worst_off_wall(load(folder, width=90, height=72, lens="legacy-pinhole").train[0]) > 0.3

    def test_the_wide_view_has_a_mask(self, raw):
        frame = load(raw, width=90, height=72, focal_scale=0.4).train[0]
        assert 0.5 < frame.mask.float().mean() < 0.99
        assert torch.isnan(frame.depth[~frame.mask]).all()
        assert frame.image[frame.mask].amax(dim=-1).min() > 0
        assert color_errors(frame).mean() < 3.0
        assert load(raw, width=90, height=72).train[0].mask is None

    def test_the_octagon_can_be_left_in(self, raw):
        masked, whole = (load(raw, width=90, height=72, focal_scale=0.4, mask=mask).train[0] for mask in (True, False))
        assert whole.mask.sum() > masked.mask.sum()

    def test_depth_beyond_its_range_is_unknown(self, my_raw):
        steps = np.full((216, 270), 65535, np.uint16)
        steps[:, :135] = 30000
        cv2.imwrite(str(my_raw / "0001_depth.tiff"), steps)
        frame = load(my_raw, width=90, height=72).train[0]
        depth, bound = frame.depth, frame.depth_at_least
        assert torch.isnan(depth[:, 60:]).all()
        assert torch.isnan(bound[:, :30]).all()
        torch.testing.assert_close(bound[:, 60:], torch.full((72, 30), 100.0))
        torch.testing.assert_close(depth[:, :30], torch.full((72, 30), 30000 * 100 / 65535))

    def test_other_files_of_the_release_are_left_alone(self, my_raw):
        for name in ("0001_flow.tiff", "0000_normals.tiff", "0000_occlusion.png", "coverage_mesh.obj", "color.png"):
            (my_raw / name).write_bytes(b"")
        assert len(load(my_raw, width=45, height=36).train) == 7


class TestSplit:
    def test_block(self, undistorted):
        scene = small(undistorted, split="block", block=(0.5, 0.8))
        assert [frame.index for frame in scene.test_sets["test"]] == [4, 5, 6]
        assert scene.provenance["split"]["block"] == [0.5, 0.8]

    def test_subsampling_comes_before_the_split(self, undistorted):
        scene = small(undistorted, frame_step=2, max_frames=4)
        assert [frame.index for frame in scene.test_sets["test"]] == [0]
        assert [frame.index for frame in scene.train] == [2, 4, 6]

    def test_no_training_frame_left(self, undistorted):
        with pytest.raises(InputError, match=r"split 'every-8th' of 1 frames .* leaves no training frames"):
            small(undistorted, max_frames=1)

    @pytest.mark.parametrize("options", [{"block": (0.6, 0.4)}, {"block": (0.5, 1.5)}, {"split": "7:1"}, {"width": 0}])
    def test_settings_that_make_no_sense(self, options):
        with pytest.raises(ValidationError):
            C3VDSettings(**options)


class TestExtras:
    @pytest.fixture
    def with_rotation(self, mine):
        write_undistorted(mine / "rotation", count=3)
        (mine / "rotation" / "seen").mkdir()
        seen = np.zeros((48, 64), np.uint8)
        seen[:, 32:] = 255
        cv2.imwrite(str(mine / "rotation" / "seen" / "0001_seen.png"), seen)
        return mine

    def test_rotation_is_a_test_set(self, with_rotation):
        scene = load(with_rotation, width=32, height=24)
        rotation = scene.test_sets["rotation"]
        assert names(rotation) == ["rotation-0000_color", "rotation-0001_color", "rotation-0002_color"]
        assert rotation[0].seen is None
        assert rotation[1].seen[:, 16:].all()
        assert not rotation[1].seen[:, :16].any()
        everything = [frame for frames in (scene.train, *scene.test_sets.values()) for frame in frames]
        assert len(set(names(everything))) == len(everything)
        assert scene.provenance["frames"] == {"in_sequence": 9, "train": 7, "test": 2, "rotation": 3}
        assert scene.provenance["rotation"]["layout"] == "undistorted"

    def test_marks_of_frames_that_do_not_exist(self, with_rotation):
        shutil.copy(with_rotation / "rotation/seen/0001_seen.png", with_rotation / "rotation/seen/0007_seen.png")
        with pytest.raises(InputError, match=r"0007_seen.png, but there are 3 frames"):
            small(with_rotation)

    def test_a_spoilt_rotation_set_is_an_error_of_its_own(self, with_rotation):
        (with_rotation / "rotation" / "camera.json").unlink()
        with pytest.raises(InputError, match=r"rotation has images but no camera.json"):
            small(with_rotation)


class TestWithoutDepth:
    @pytest.fixture
    def points(self):
        return PointCloud(torch.rand(50, 3), torch.randint(0, 256, (50, 3), dtype=torch.uint8))

    def test_points_come_from_the_scenes_ply(self, tmp_path, points):
        scene = small(write_undistorted(tmp_path / "wall", depths=None, points=points))
        assert all(frame.depth is None for frame in scene.train)
        torch.testing.assert_close(scene.points.positions, points.positions)
        assert torch.equal(scene.points.colors, points.colors)
        assert scene.provenance["points"]["source"] == "points3D.ply"
        assert scene.provenance["invalid_depth_share"] is None

    def test_points_without_colour(self, tmp_path):
        folder = write_undistorted(tmp_path / "wall", depths=None, points=PointCloud(torch.rand(5, 3)))
        assert small(folder).points.colors is None

    def test_points_from_a_named_file(self, mine, points, tmp_path):
        np.savez(mine / "cloud.npz", positions=points.positions.numpy())
        scene = small(mine, initial_points="file", points_file="cloud.npz")
        torch.testing.assert_close(scene.points.positions, points.positions)
        assert scene.train[0].depth is not None
        elsewhere = (mine / "cloud.npz").rename(tmp_path / "elsewhere.npz")
        other = small(mine, initial_points="file", points_file=str(elsewhere), points_count=7)
        assert len(other.points) == 7
        assert other.provenance["points"]["source"] == "elsewhere.npz"

    def test_a_missing_file(self, mine):
        with pytest.raises(InputError, match=r"no file .*nothing.ply"):
            small(mine, initial_points="file", points_file="nothing.ply")


class TestProvenance:
    def test_says_where_everything_came_from(self, raw):
        scene = load(raw, width=90, height=72)
        said = scene.provenance
        json.dumps(said, allow_nan=False)
        assert said["dataset"] == "c3vd"
        assert said["layout"] == "raw"
        assert said["lens"] == "omnidirectional"
        assert said["stored_size"] == [270, 216]
        assert said["split"]["name"] == "every-8th"
        assert said["split"]["train"] == names(scene.train)
        assert said["split"]["test_sets"] == {"test": ["0000_color", "0008_color"]}
        assert said["frames"] == {"in_sequence": 9, "train": 7, "test": 2}
        assert said["intrinsics"]["cx"] == scene.train[0].camera.cx
        assert said["points"] == {"source": "depth of the training frames", "count": len(scene.points), "seed": 0}
        assert said["invalid_depth_share"] == 0.0

    def test_share_of_unknown_depth(self, mine):
        for index in range(9):
            steps = np.full((48, 64), 30000, np.uint16)
            steps[:12] = 65535
            cv2.imwrite(str(mine / f"depths/{index:04d}_depth.png"), steps)
        assert small(mine).provenance["invalid_depth_share"] == pytest.approx(0.25)

    def test_fingerprint_changes_with_the_data_only(self, undistorted, mine):
        def fingerprint(folder):
            return small(folder).provenance["fingerprint"]

        original = fingerprint(undistorted)
        assert fingerprint(mine) == original
        (mine / "notes.txt").write_text("hello")
        assert fingerprint(mine) == original
        cv2.imwrite(str(mine / "images/0003_color.png"), np.zeros((48, 64, 3), np.uint8))
        changed = fingerprint(mine)
        assert changed != original
        text = (mine / "camera_pose.txt").read_text()
        (mine / "camera_pose.txt").write_text(text + "\n")
        assert fingerprint(mine) not in (original, changed)


def test_a_folder_of_something_else(tmp_path):
    for index in range(9):
        (tmp_path / f"{index}.txt").touch()
    with pytest.raises(InputError, match=r"holds 0.txt, 1.txt, 2.txt, 3.txt, 4.txt and 4 more"):
        small(tmp_path)


def test_what_the_writer_refuses(tmp_path):
    with pytest.raises(InputError, match="9 images, 9 poses and 1 depths"):
        write_undistorted(tmp_path / "wall", depths=[np.ones((48, 64))])
    assert not (tmp_path / "wall").exists()
    write_undistorted(tmp_path / "wall", count=2)
    with pytest.raises(InputError, match="already exists"):
        write_undistorted(tmp_path / "wall", count=2)
    write_undistorted(tmp_path / "wall", count=3, overwrite=True)
    assert len(list((tmp_path / "wall" / "images").iterdir())) == 3


def test_the_writers_intrinsics_are_opencvs(undistorted):
    assert read_intrinsics(undistorted / "camera.json") == PINHOLE
